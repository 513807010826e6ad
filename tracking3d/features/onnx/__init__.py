"""Feature encoder ``onnx``: any dense network in an ONNX file, told by a few lines of YAML what it takes and gives."""
