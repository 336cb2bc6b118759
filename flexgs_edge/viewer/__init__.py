"""The viewer of scenes in a browser: its files, a server for one scene, and a page of one file."""
