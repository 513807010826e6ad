"""Where work on many videos is done: processes of this machine, or a Ray cluster; and the loop that hands it out."""
