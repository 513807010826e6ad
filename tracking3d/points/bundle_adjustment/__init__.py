"""Poses and points of one rigid object that explain tracked pixels best, over any number of frames."""

from tracking3d.points.bundle_adjustment.adjustment import Structure, Tracks, adjust

__all__ = ["Structure", "Tracks", "adjust"]
