"""Mask trackers: 2D trackers that give a rough mask of the object in every frame."""
