"""Neural networks in ONNX files: where they are found and how they are run."""
