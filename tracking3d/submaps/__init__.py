"""Long videos in parts: cut where the object is well seen, tracked side by side, merged into one object and one run."""
