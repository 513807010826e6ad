"""``python -m tracking3d``: the command line where the console script is not on the path."""

from __future__ import annotations

from tracking3d.cli import main

if __name__ == "__main__":
    main()
