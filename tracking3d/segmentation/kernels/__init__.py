"""Compiled inner loops of the evidence; each has a twin in NumPy or torch in the module it is named after."""
