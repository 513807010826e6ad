"""Many videos: what is to be tracked, each in a worker, each into a run folder that appears whole or not at all."""
