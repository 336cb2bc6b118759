"""`study speed`: how much quality less work costs, and where time is spent."""
