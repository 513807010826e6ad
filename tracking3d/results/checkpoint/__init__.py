"""The state of a run between two frames, saved beside its estimates so that a stopped run can be resumed."""
