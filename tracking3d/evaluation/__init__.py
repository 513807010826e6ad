"""Measures of estimates against the truth."""
