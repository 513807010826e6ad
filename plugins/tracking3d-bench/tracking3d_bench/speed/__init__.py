"""Benchmarks of the renderer: time, memory, growth."""
