"""Access control of the pages that tracking3d serves."""
