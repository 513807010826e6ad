"""Long videos in parts: cut at frames that show the object well, tracked in parallel, merged into one run."""
