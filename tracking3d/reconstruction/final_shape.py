"""The shape of a run's mesh, reconstructed again if its configuration asks for it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tracking3d.config.models import ObjectConfig, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.rendering.backend import share_threads
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_notes import note_in_run, timed_pass
from tracking3d.results.run_reader import RunReader
from tracking3d.video.source import FrameSource

_TEXTURE_VIEWS: int = ObjectConfig.model_fields["texture_views"].default


def is_reconstructed(
    records: Iterable[FrameRecord], config: PipelineConfig, source: FrameSource | None = None
) -> bool:
    """Whether ``object.shape`` asks for a new shape, and with ``auto`` whether packages, frames and motion allow it.

    Args:
        records: The final estimates.
        config: Config of the run.
        source: Its video; None if it can be read again.
    """
    from tracking3d.reconstruction.rebuild import has_packages
    from tracking3d.reconstruction.shape import FEWEST, LEAST_TURN, largest_turn

    if config.object.shape != "auto" or config.object.extends is not None:
        return config.object.shape == "fine" or config.object.extends is not None
    if not (config.solver.final_refine and config.object.texture_views):
        return False
    if source is not None and not source.repeatable:
        return False
    final = [record for record in records if record.refined and record.status is Status.TRACKED]
    if any(record.free_axis for record in final):  # a surface of revolution is smooth, that of all frames not
        return False
    rotations = [record.T_cam_obj[:3, :3] for record in final]
    return has_packages() and len(rotations) >= FEWEST and largest_turn(np.stack(rotations)) >= LEAST_TURN


def make_final_shape(folder: Path, config: PipelineConfig, source: FrameSource, always: bool = False) -> str:
    """Reconstruct the shape of a finished run if ``object.shape`` asks for it; if that is not possible, the mesh stays.

    With ``object.extends`` the frames of an earlier run make the mesh, too. What came of it stands in ``run.json`` as
    well, under ``shape``. With ``auto`` nothing is said if it is not possible.

    Args:
        folder: The run folder.
        config: Config of the run.
        source: Its video.
        always: Reconstruct it whatever the config says.

    Returns:
        What came of it, in a sentence; empty if nothing was asked.

    Raises:
        OutputError: If something cannot be written.
    """
    if config.object.extends is not None:
        with timed_pass(folder, "shape"), share_threads(1):
            sentence = _extend(folder, config, source)
        note_in_run(folder, {"shape": sentence})
        return sentence
    from tracking3d.reconstruction.rebuild import rebuild_shape  # slow to import, and only needed at the end

    records = RunReader(folder).frames if config.object.shape == "auto" and not always else ()
    if not (always or is_reconstructed(records, config, source)):
        return ""
    with timed_pass(folder, "shape"), share_threads(1):
        try:
            sentence = (
                f"The shape stays, for {source.name} comes once only and all frames are needed a second time."
            )
            if source.repeatable:
                sentence = rebuild_shape(folder, source, *texture_limits(config)).sentence
        except InputError as error:
            sentence = str(error)
    note_in_run(folder, {"shape": sentence})
    return sentence


def texture_limits(config: PipelineConfig) -> tuple[int, int]:
    """Most frames that a reconstructed shape takes its texture from, and most texels along a side."""
    return config.object.texture_views or _TEXTURE_VIEWS, config.object.max_texture_size


def _extend(folder: Path, config: PipelineConfig, source: FrameSource) -> str:
    """Make the model from a run's frames and an earlier run's; what came of it, in a sentence."""
    from tracking3d.reconstruction.extension import extend_run  # slow to import, and only needed at the end
    from tracking3d.reconstruction.rebuild import rebuild_shape

    limits = texture_limits(config)
    if not source.repeatable:
        return f"The model is not extended, for {source.name} comes once only and all frames are needed a second time."
    try:
        extended = extend_run(folder, Path(str(config.object.extends)), source, *limits)
    except InputError as error:
        reason = str(error)
        try:
            return (
                f"{reason} The mesh shows this video alone: {rebuild_shape(folder, source, *limits).sentence}"
            )
        except InputError:
            return reason
    return extended.sentence
