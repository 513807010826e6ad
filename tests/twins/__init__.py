"""Slow and obvious references of the compiled kernels: the tests compare both on random input.

Each function here takes what the function of the same name in the package takes, and gives the same to rounding.
"""
