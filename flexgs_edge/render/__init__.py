"""One view: one camera, one picture, and what a view adds up."""
