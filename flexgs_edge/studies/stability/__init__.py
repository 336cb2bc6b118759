"""`study stability`: under which conditions methods break."""
