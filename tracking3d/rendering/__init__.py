"""The differentiable renderer (DIB-R). Knows nothing of video or tracking."""
