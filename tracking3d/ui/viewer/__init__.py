"""The web viewer of run folders, by viser."""
