"""One video from its frames to estimates and a run folder."""
