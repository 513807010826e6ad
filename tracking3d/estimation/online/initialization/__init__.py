"""From pending frames to a first map."""
