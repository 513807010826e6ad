"""Who may talk to the pages that tracking3d serves."""
