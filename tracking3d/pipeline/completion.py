"""A finished run that is resumed: what it lacks is made again from what it has."""

from __future__ import annotations

import logging
from pathlib import Path

from tracking3d.checkpoint.integrity import RunIntegrity
from tracking3d.config.models import PipelineConfig
from tracking3d.pipeline.frame_reading import read_again
from tracking3d.reconstruction.final_shape import is_reconstructed, make_final_shape
from tracking3d.results import layout
from tracking3d.results.artefacts import PICTURES, missing_files
from tracking3d.results.mesh_export import export_mesh, load_model, restore_texture
from tracking3d.results.redrawing import redraw_contact_sheet, redraw_overlay
from tracking3d.results.run_reader import RunReader
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)
_MADE_AGAIN = "%s: made again, since the finished run lacks it: %s."


def is_intact(folder: Path) -> bool:
    """Whether the estimates and the model of a finished run are whole; if not, a sentence says what is damaged.

    A texture that is missing is taken from ``mesh.glb``.

    Raises:
        OutputError: If the texture cannot be written.
    """
    if restore_texture(folder):
        _log.warning(_MADE_AGAIN, folder, layout.TEXTURE)
    damage = RunIntegrity(folder).of_finished(RunReader(folder))
    if damage:
        _log.warning(
            "%s: %s; what depends on it is computed again, and until then the run stays as it is.",
            folder,
            damage,
        )
    return not damage


def complete_run(folder: Path, config: PipelineConfig, source: FrameSource) -> None:
    """Make again what a finished run lacks: files of its mesh, its shape, the overlay, the contact sheet.

    Args:
        folder: The run folder; estimates and model in it are whole.
        config: Its configuration.
        source: Its video.

    Raises:
        InputError: If the run is damaged.
        OutputError: If something cannot be written.
    """
    missing = missing_files(folder, (*layout.MESH_FILES, *PICTURES))
    run = RunReader(folder)
    shapeless = "shape" not in run.description and is_reconstructed(run.frames, config, source)
    if missing or shapeless:
        names = [*missing, *(["the shape from all frames"] if shapeless else [])]
        _log.warning(_MADE_AGAIN, folder, ", ".join(names))
    if not set(layout.MESH_FILES).isdisjoint(missing):
        export_mesh(folder, load_model(folder), RunReader(folder).unit)
    if layout.OVERLAY in missing:
        redraw_overlay(RunReader(folder), read_again(source))
    elif layout.CONTACT_SHEET in missing:
        redraw_contact_sheet(RunReader(folder))
    if shapeless:
        make_final_shape(folder, config, source)
