"""`study speed`: how much time each method and effort takes, and what it finds."""
