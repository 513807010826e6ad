"""Time, threads, memory and random state of the process."""
