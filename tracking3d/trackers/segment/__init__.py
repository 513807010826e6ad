"""Masks by a small segmentation network that this project trained and that comes with the package."""
