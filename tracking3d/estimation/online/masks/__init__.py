"""From a pose to the frame's mask and estimate."""
