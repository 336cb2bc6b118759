"""A scene as a set of Gaussians, wherever it comes from: sources that are read in parts, fields and checks."""
