"""Batches of videos: each is tracked in a worker, and its run folder appears completely or not at all."""
