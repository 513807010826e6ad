"""Numba kernels of the mask trackers; each file belongs to the module of the same name one folder up."""
