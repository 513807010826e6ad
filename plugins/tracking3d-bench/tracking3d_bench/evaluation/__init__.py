"""Metrics of estimates against ground truth."""
