"""Frame sources and the video writer."""
