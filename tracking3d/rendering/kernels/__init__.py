"""Numba kernels of the renderer: float32 on the CPU, with gradients written by hand.

Each file is the fast twin of the module of the same name one folder up, which is its specification.
"""
