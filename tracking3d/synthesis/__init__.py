"""Clips with exact truth, made by ray casting that shares nothing with the renderer under test."""
