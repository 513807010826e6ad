"""Least squares: poses, points, shape and shading. No state."""
