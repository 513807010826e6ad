"""Reading the sequences of any data set that has a description, see `tracking3d_bench.datasets.layout`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.trackers.crops import box_of
from tracking3d.video.image_sequence import images_among
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.datasets.layout import DatasetLayout
from tracking3d_bench.datasets.listing import find_sequence, object_names, sequence_names
from tracking3d_bench.datasets.placeholders import Place
from tracking3d_bench.datasets.sequence_files import SequenceFiles
from tracking3d_bench.datasets.truth import Truth


def list_sequences(layout: DatasetLayout, root: Path) -> list[str]:
    """Names of a data set's sequences in order; ``sequence/object`` if a sequence has several objects.

    Raises:
        InputError: If the folder or its sequences are missing, or a file that lists objects is damaged.
    """
    names = []
    for sequence in sequence_names(layout, root):
        objects = object_names(layout, Place(root, sequence))
        names += [sequence] if len(objects) < 2 else [f"{sequence}/{name}" for name in objects]
    return names


def read_sequence(layout: DatasetLayout, root: Path, name: str) -> Truth:
    """Read one sequence, named as `list_sequences` does.

    Images are read when they are asked for. A frame in which the object is known to be out of sight has an empty
    mask, in data sets of boxes too.

    Raises:
        InputError: If there is no such sequence, a file that the description names is missing or damaged, or
            there is nothing to score.
    """
    place = find_sequence(layout, root, name)
    if layout.clips:
        return replace(read_truth(root / layout.sequences.inside / place.sequence), name=name)
    frames = tuple(images_among(place.files(layout.frames)))
    if not frames:
        raise InputError(
            f"The sequence '{name}' has no images {' or '.join(layout.frames)} in {root}; restore them."
        )
    files = SequenceFiles(layout, place, frames)
    masks, visible_masks = files.masks(layout.masks), files.masks(layout.visible_masks)
    drawn, boxes = files.regions(layout.regions)
    masks |= drawn
    truth = Truth(
        name=name,
        frames=frames,
        camera=files.camera(),
        T_cam_obj=files.poses(),
        masks=masks or visible_masks,
        visible_masks=visible_masks,
        boxes=boxes,
        depth=files.depth(),
        mesh=files.mesh(),
        initial_masks=files.masks(layout.initial_masks),
        millimetres=layout.millimetres,
        symmetries=files.symmetries(),
    )
    if not (truth.masks or truth.boxes or truth.T_cam_obj):
        raise InputError(f"The sequence '{name}' in {root} has no masks, boxes or poses: nothing to score.")
    return replace(truth, box=_first_box(files, truth))


def _first_box(files: SequenceFiles, truth: Truth) -> Box | None:
    """The object in frame 0: as a file of its own tells, its box, or the box around what is seen of it."""
    masks, boxes = files.regions(files.layout.box)
    if 0 in boxes or (0 in truth.boxes and 0 not in masks):
        return boxes.get(0) or truth.boxes[0]
    mask = masks.get(0) or truth.visible_masks.get(0) or truth.masks.get(0)
    return box_of(mask.read()) if mask else None
