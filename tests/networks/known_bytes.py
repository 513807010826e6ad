"""The contents of the network that the tests know."""

BYTES = bytes(range(256)) * 4000
