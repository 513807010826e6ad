"""The commands ``evaluate``, ``synth`` and ``bench``, which `tracking3d.cli.plugged_commands` finds."""
