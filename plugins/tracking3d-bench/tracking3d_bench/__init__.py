"""Measuring: datasets, scores, synthetic sequences, benchmarks, and the tracker for the VOT toolkit."""
