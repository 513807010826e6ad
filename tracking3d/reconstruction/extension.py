"""The model of an object from several videos: each shows sides that the others do not.

The object of an earlier run is registered with that of a run (`registration`), and the frames of both make one surface
and one texture, in the coordinates of the run. An earlier run that extends others brings their frames, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction.rebuild import ShapedRun, check_packages, online_model, reshape_run
from tracking3d.reconstruction.registration import Registration, register_run
from tracking3d.reconstruction.run_views import RunViews, collect_views
from tracking3d.reconstruction.unseen_closing import close_unseen
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_source import open_run_source
from tracking3d.video.source import FrameSource

NOTE = "extends"
"""Key in ``run.json`` of the runs that a run extends."""


@dataclass(frozen=True, eq=False)
class ExtendedRun:
    """What came of it.

    Attributes:
        shaped: The model.
        registration: How the earlier run's object lies in the coordinates of this one.
    """

    shaped: ShapedRun
    registration: Registration

    @property
    def sentence(self) -> str:
        """What came of it, in a sentence."""
        found = self.registration
        return (
            f"{found.matches} matched keypoints in {found.pairs} pairs of frames tell how the earlier object lies in "
            f"this one; {self.shaped.sentence}"
        )


def extend_run(
    folder: Path,
    earlier: Path,
    source: str | FrameSource | None = None,
    most: int = 24,
    largest: int = 2048,
) -> ExtendedRun:
    """Make the model of a run from its frames and those of an earlier run of the same object, and write it.

    How the earlier object lies in the run's coordinates is noted in ``run.json`` under `NOTE`.

    Args:
        folder: The run folder.
        earlier: That of the earlier run; it stays as it is.
        source: The run's video, or its path; None for the one that the run names.
        most: Frames of each run that the texture is taken from.
        largest: Most texels along a side.

    Raises:
        InputError: If a package is missing, a run goes on, has no mesh or no reliable frame, its video cannot be
            read, or the two show too little in common.
        OutputError: If the mesh cannot be written.
    """
    check_packages()
    if folder.resolve() == earlier.resolve():
        raise InputError(f"{folder} cannot extend itself; give the folder of another run.")
    run, known = RunReader(folder), RunReader(earlier)
    online = online_model(run)
    own = collect_views(run, source, most, online)
    known_model = load_model(known.mesh_folder)
    other = collect_views(known, open_run_source(known), most, known_model)
    registration = register_run(own.keypoints, other.keypoints)
    parts, models = [own], []
    runs = [(known, registration.similarity, other), *_runs_extended_by(known, registration.similarity, most)]
    for number, (one, similarity, views) in enumerate(runs, start=1):
        parts.append(views.moved(similarity, number))
        models.append(_moved(load_model(one.mesh_folder), similarity))
    together = RunViews(
        [view for part in parts for view in part.shapes],
        [view for part in parts for view in part.left_out],
        tuple(view for part in parts for view in part.textures),
    )
    shaped = reshape_run(run, close_unseen(online), together, largest, models, own.textures)
    if shaped.new:
        note_in_run(folder, {NOTE: {"run": str(earlier.resolve()), **_describe(registration)}})
    return ExtendedRun(shaped, registration)


def _runs_extended_by(
    run: RunReader, similarity: Similarity, most: int
) -> Iterator[tuple[RunReader, Similarity, RunViews]]:
    """The runs that a run extends itself, each with the similarity to the coordinates that ``similarity`` leads to."""
    note = run.description.get(NOTE)
    visited = {run.folder.resolve()}
    while isinstance(note, Mapping) and Path(note["run"]).resolve() not in visited:
        run = RunReader(Path(note["run"]))
        visited.add(run.folder.resolve())
        similarity = similarity.after(_similarity(note))
        yield run, similarity, collect_views(run, open_run_source(run), most)
        note = run.description.get(NOTE)


def _moved(model: ObjectModel, similarity: Similarity) -> ObjectModel:
    return replace(model, vertices=similarity.points(model.vertices))


def _describe(registration: Registration) -> dict[str, Any]:
    similarity = registration.similarity
    return {
        "R": similarity.R.tolist(),
        "scale": similarity.scale,
        "translation": similarity.translation.tolist(),
        "matches": registration.matches,
        "pairs_of_frames": registration.pairs,
        "reprojection_error": round(registration.error, 3),
    }


def _similarity(note: Mapping[str, Any]) -> Similarity:
    return Similarity(np.array(note["R"]), float(note["scale"]), np.array(note["translation"]))
