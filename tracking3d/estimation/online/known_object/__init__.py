"""A solver whose map is given before the video."""
