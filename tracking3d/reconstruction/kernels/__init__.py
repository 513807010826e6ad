"""Compiled loops over voxels and pixels."""
