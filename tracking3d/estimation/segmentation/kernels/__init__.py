"""Compiled inner loops of the segmentation; each file belongs to the module of the same name one folder up."""
