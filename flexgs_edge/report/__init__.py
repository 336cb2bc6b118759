"""The result record of every job, its JSON and its text."""
