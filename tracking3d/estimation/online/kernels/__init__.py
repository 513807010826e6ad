"""Numba kernels of what points say of poses and shape: float64, and no sum depends on the processor.

Each file belongs to the module of the same name one folder up, which says what is computed.
"""
