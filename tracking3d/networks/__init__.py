"""Neural networks in ONNX files: finding and running them."""
