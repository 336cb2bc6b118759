"""Bytes held: the budget, what the system says, and arrays in memory or in scratch files."""
