"""`study speed`: time against quality, and where the time goes."""
