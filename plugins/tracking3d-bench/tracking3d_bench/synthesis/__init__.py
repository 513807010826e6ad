"""Synthetic sequences with exact truth: scenes, motions, lighting, and the suites made of them."""
