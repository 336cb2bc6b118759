"""One module per command: the functions that the command line and Python users call."""
