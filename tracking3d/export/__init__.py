"""Runs in the formats of other tools: one small module per format, listed in `tracking3d.export.formats`.

A module of a format knows an `tracking3d.export.exported_run.ExportedRun`, which gives poses, masks, mesh and
pictures, and the place that it is to write to; where that is, and that it appears whole or not at all, is the business
of `tracking3d.export.exporting`.
"""
