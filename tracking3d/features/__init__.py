"""Feature encoders: what the appearance loss compares."""
