"""Cameras with lenses: files that describe them, boards to measure them by, and the measurement."""
