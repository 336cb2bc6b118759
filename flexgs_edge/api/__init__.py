"""The Python API besides the commands: scenes and cameras from arrays, coding to and from bytes, open files."""
