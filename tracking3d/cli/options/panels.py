"""Headings in the help texts, the same for all commands."""

from __future__ import annotations

PROMPT = "Prompt"
VIDEO = "Video"
DATA = "Data"
TRACKING = "Tracking"
CAMERA = "Camera"
SETTINGS = "Settings"
OUTPUT = "Output"
PERFORMANCE = "Performance"
