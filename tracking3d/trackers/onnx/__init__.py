"""Mask tracker ``onnx``: a box tracker gives the region, a segmentation network in an ONNX file the mask."""
