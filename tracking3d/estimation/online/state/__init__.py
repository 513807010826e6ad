"""What the solver knows: the object's map, keyframes, and how far a pose is to be trusted."""
