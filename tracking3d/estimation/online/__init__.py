"""The solver that joins matching with re-rendering: tracks every frame, maps when it pays."""
