"""Numba kernels of the mask trackers; each file is the fast twin of the module of the same name one folder up."""
