"""Mask tracker ``onnx``: a box tracker proposes, a segmentation network in an ONNX file disposes."""
