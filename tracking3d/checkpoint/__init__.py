"""The state of a run between two frames, kept beside its estimates so that a stopped run can go on."""
