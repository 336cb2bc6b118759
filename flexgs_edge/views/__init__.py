"""Many views: references, sums over views, the workers of a cluster."""
