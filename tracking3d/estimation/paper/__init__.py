"""The solver of Rozumnyi et al., ICCV 2023: one Adam over everything, in every frame."""
