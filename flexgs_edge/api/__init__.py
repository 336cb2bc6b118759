"""What Python users hold that is no command: scenes and cameras of arrays, bytes in and out, an open file."""
