"""The model of an object from several videos: each shows sides that the others do not.

The object of an earlier run is registered with that of a run (`registration`), and the frames of both make one surface
and one texture, in the coordinates of the run. An earlier run that extends others brings their frames, too.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction.rebuild import EXTENDS, ShapedRun, check_packages, online_model, reshape_run
from tracking3d.reconstruction.registration import Registration, register_run
from tracking3d.reconstruction.reliable_frames import no_reliable_frame_error
from tracking3d.reconstruction.run_views import RunViews, collect_views
from tracking3d.reconstruction.unseen_closing import close_unseen
from tracking3d.results import layout
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_source import open_run_source
from tracking3d.results.run_unit import unit_scale
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ExtendedRun:
    """What came of it."""

    shaped: ShapedRun  # the model
    registration: Registration  # how the earlier run's object lies in the coordinates of this one

    @property
    def sentence(self) -> str:
        """What came of it, in a sentence."""
        found = self.registration
        matched = f"{found.matches} matched keypoints in {found.pairs} pairs of frames"
        registered = f"{matched} tell how the earlier object lies in this one"
        if not self.shaped.new:
            return f"{registered}, but the mesh is made from this video alone. {self.shaped.sentence}"
        return f"{registered}; {self.shaped.sentence}"


def extend_run(
    folder: Path,
    earlier: Path,
    source: str | FrameSource | None = None,
    most: int = 24,
    largest: int = 2048,
) -> ExtendedRun:
    """Make the model of a run from its frames and those of an earlier run of the same object, and write it.

    How the earlier object lies in the run's coordinates is noted in ``run.json`` under `EXTENDS`, if its frames made
    the mesh. A run that extended another one before extends this one instead.

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
    other = _views_of_earlier(known, most, load_model(known.mesh_folder))
    for one, views in ((run, own), (known, other)):
        if not views.textures:
            raise no_reliable_frame_error(one)
    registration = register_run(own.keypoints, other.keypoints)
    parts, models = [own], []
    runs = [(known, registration.similarity, other)]
    runs += _runs_extended_by(known, registration.similarity, most, folder)
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
        scales = {"own_unit": unit_scale(run), "earlier_unit": unit_scale(known)}
        note_in_run(folder, {EXTENDS: {"run": str(earlier.resolve()), **_describe(registration), **scales}})
    return ExtendedRun(shaped, registration)


def check_earlier_run(earlier: Path) -> None:
    """Make sure that a run can be extended, as far as that can be seen before its video is read.

    Raises:
        InputError: If it is no run, still going, or its video is not there.
    """
    run = RunReader(earlier)
    if run.state == "running":
        raise InputError(f"The run {earlier} is still going; wait for its end.")
    _open_earlier(run)


def _open_earlier(run: RunReader) -> FrameSource:
    try:
        return open_run_source(run)
    except InputError as error:
        raise InputError(
            f"The video of the earlier run {run.folder} cannot be read; put it where its run.json says it was: "
            f"{run.description.get('source')!r:.200}."
        ) from error


def _views_of_earlier(run: RunReader, most: int, model: ObjectModel | None = None) -> RunViews:
    return collect_views(run, _open_earlier(run), most, model)


def _runs_extended_by(
    run: RunReader, similarity: Similarity, most: int, own: Path
) -> Iterator[tuple[RunReader, Similarity, RunViews]]:
    """The runs that a run extends itself, each with the similarity to the coordinates that ``similarity`` leads to.

    One that cannot be read, or its video, ends the chain with a warning: what is there is used.

    Args:
        run: The run.
        similarity: From its object coordinates.
        most: Frames that a texture is taken from.
        own: The run folder that is extended, whose frames are there already.
    """
    visited = {own.resolve(), run.folder.resolve()}
    while (note := run.description.get(EXTENDS)) is not None:
        try:
            earlier, to_run = _parse_note(run, note)
            if earlier.resolve() in visited:
                return
            visited.add(earlier.resolve())
            views = _views_of_earlier(RunReader(earlier), most)
            similarity = similarity.after(to_run)
        except InputError as error:
            _log.warning("%s is extended without the runs that it extends itself: %s", run.folder, error)
            return
        run = RunReader(earlier)
        yield run, similarity, views


def _parse_note(run: RunReader, note: Any) -> tuple[Path, Similarity]:
    """The earlier run that a note names, and the similarity from its present coordinates to the run's.

    Raises:
        InputError: If the note is damaged.
    """
    try:
        earlier = Path(note["run"])
        R, translation = np.array(note["R"], float), np.array(note["translation"], float)
        scale = float(note["scale"])
        own_unit, earlier_unit = float(note.get("own_unit", 1.0)), float(note.get("earlier_unit", 1.0))
        numbers = [*R.ravel(), *translation, scale, own_unit, earlier_unit]
        sound = R.shape == (3, 3) and translation.shape == (3,) and np.isfinite(numbers).all() and scale > 0
    except (AttributeError, KeyError, TypeError, ValueError):
        sound = False
    if not sound:
        raise InputError(f"{run.folder / layout.RUN} is damaged: {EXTENDS} is {note!r:.60}; restore it.")
    # Either run may have been put into metres since.
    own, other = unit_scale(run) / own_unit, unit_scale(RunReader(earlier)) / earlier_unit
    return earlier, Similarity(R, scale * own / other, translation * own)


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
