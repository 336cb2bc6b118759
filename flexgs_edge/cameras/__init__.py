"""Where somebody stood: cameras, their files, photos, automatic views, orders of poses."""
