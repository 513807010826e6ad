"""The run folder: writing, reading, and everything drawn or exported from it."""
