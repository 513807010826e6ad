"""The state of a run between two frames, kept beside its answers so that a stopped run can go on."""
