"""Frames cut out around the object, and its surface drawn into them. Knows nothing of video or tracking."""
