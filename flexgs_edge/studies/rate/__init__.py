"""`study rate`: bytes against quality, and what each part is worth."""
