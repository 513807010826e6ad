"""Measures, clips with known truth, and benchmarks."""
