"""What stays and how finely: one folder a method, one door each (`method.py`)."""
