"""Ground truth of clips and estimates for them, in any layout on disk."""
