"""Camera, pose, mesh, prototypes and texture atlas. Knows nothing of video or tracking."""
