"""What a person or a program reads: records, text, JSON, pages and charts."""
