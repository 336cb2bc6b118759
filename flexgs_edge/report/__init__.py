"""Results for people and programs: records, text, JSON, pages and charts."""
