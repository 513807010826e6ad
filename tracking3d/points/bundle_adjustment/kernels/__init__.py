"""Numba kernels of points seen by posed cameras: float64, and no sum depends on the processor.

They compute what `tracking3d.points.bundle_adjustment` says; the tests hold slow and obvious references against them.
"""
