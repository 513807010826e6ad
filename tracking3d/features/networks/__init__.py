"""Neural networks in ONNX files: catalogue, download, cache, and inference."""
