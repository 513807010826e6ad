"""From frames and rough masks to shape, texture and poses."""
