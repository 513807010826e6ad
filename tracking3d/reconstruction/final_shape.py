"""The shape of a run's mesh, reconstructed again if its configuration asks for it."""

from __future__ import annotations

from pathlib import Path

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.reconstruction.rebuild import rebuild_shape
from tracking3d.results.run_notes import note_in_run
from tracking3d.video.source import FrameSource


def make_final_shape(folder: Path, config: PipelineConfig, source: FrameSource, always: bool = False) -> str:
    """Reconstruct the shape of a finished run if ``object.shape`` is ``fine``; if that is not possible, the mesh stays.

    What came of it stands in ``run.json`` under ``shape`` too.

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
    if config.object.shape != "fine" and not always:
        return ""
    if source.repeatable:
        try:
            sentence = rebuild_shape(folder, source).sentence
        except InputError as error:
            sentence = str(error)
    else:
        sentence = (
            f"The shape stays, for {source.name} comes once only and all frames are needed a second time."
        )
    note_in_run(folder, {"shape": sentence})
    return sentence
