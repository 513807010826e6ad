"""Feature encoder ``onnx``: any dense network in an ONNX file, with inputs and outputs described in a few lines of
YAML."""
