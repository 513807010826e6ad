"""Numba kernels of points seen by posed cameras: float64, and no sum depends on the processor.

`tracking3d.bundle_adjustment` is their specification, and runs where they do not.
"""
