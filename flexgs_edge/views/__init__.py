"""Draw many views: reference renders, sums over views."""
