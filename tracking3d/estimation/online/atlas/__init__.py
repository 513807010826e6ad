"""Several maps: switching between them, aligning and merging them."""
