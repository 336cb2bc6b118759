"""What is asked and what a search has seen: targets, steps and choices, without arrays."""
