"""Synthetic clips with exact ground truth, made by ray casting that shares no code with the renderer under test."""
