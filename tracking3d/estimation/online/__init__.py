"""The online solver: tracks every frame by matching and re-rendering, and extends its map if a frame adds something."""
