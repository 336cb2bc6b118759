"""Methods of compression: each decides which Gaussians stay and how finely they are coded. Enter a folder by `method.py`."""
