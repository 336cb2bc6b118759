"""Draw many views: reference renders, sums over views, and the workers of a cluster."""
