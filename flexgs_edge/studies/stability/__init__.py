"""`study stability`: where methods break, and where ours stops standing."""
