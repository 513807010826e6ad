"""The sequences of a data set and the objects in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tracking3d.config.explain import hint
from tracking3d.errors import InputError
from tracking3d.video.source import natural_order
from tracking3d_bench.datasets.bop import read_scene_gt
from tracking3d_bench.datasets.layout import DatasetLayout
from tracking3d_bench.datasets.masks import read_labels
from tracking3d_bench.datasets.placeholders import Place

VOID = 255
"""Label of pixels that belong to no object, if there are other labels (DAVIS)."""


def find_sequence(layout: DatasetLayout, root: Path, name: str) -> Place:
    """The sequence called ``name``, and its object if it is called ``sequence/object``.

    Raises:
        InputError: If there is none.
    """
    sequences = sequence_names(layout, root)
    whole, _, last = name.rpartition("/")
    sequence, wanted = (name, None) if name in sequences else (whole, last)
    if sequence not in sequences:
        raise InputError(
            f"The data set {layout.name} in {root} has no sequence '{name}'; {hint(name, sequences)}"
        )
    place = Place(root, sequence)
    objects = object_names(layout, place)
    if wanted is None and len(objects) > 1:
        raise InputError(
            f"The sequence '{name}' has several objects; name one of "
            + ", ".join(f"{name}/{each}" for each in objects)
            + "."
        )
    if wanted is not None and (len(objects) < 2 or wanted not in objects):
        raise InputError(f"The sequence '{sequence}' has no object '{wanted}'; {hint(wanted, objects)}")
    return replace(place, object=wanted or next(iter(objects), None))


def sequence_names(layout: DatasetLayout, root: Path) -> list[str]:
    """Names of a data set's sequences in order.

    Raises:
        InputError: If the folder or its sequences are missing.
    """
    if not root.is_dir():
        raise InputError(f"There is no folder {root}; give the folder of the data set {layout.name}.")
    told = layout.sequences
    inside = root / told.inside
    listing = Place(root, "").file(told.list or ())
    if listing is not None:
        names = _names_in(listing)
        missing = next((name for name in names if not (inside / name).is_dir()), None)
        if missing is not None:
            raise InputError(f"{listing} names the sequence '{missing}', but there is no {inside / missing}.")
        return names
    folders = [
        path
        for path in sorted(inside.glob(told.folders), key=natural_order)
        if path.is_dir() and not path.name.startswith(".")
    ]
    names = [
        path.relative_to(inside).as_posix()
        for path in folders
        if not told.holding or any(next(path.glob(pattern), None) for pattern in told.holding)
    ]
    if not names:
        holding = f" holding {' or '.join(told.holding)}" if told.holding else ""
        raise InputError(
            f"{root} is not the data set {layout.name}: it has no folders {told.inside}/{told.folders}{holding}."
        )
    return names


def object_names(layout: DatasetLayout, place: Place) -> list[str]:
    """Names of the objects of one sequence; none if it has one without a name.

    Raises:
        InputError: If a file that lists objects is missing or damaged.
    """
    if layout.objects == "one":
        return []
    if layout.objects == "masks":
        return _labels(layout, place)
    if layout.objects == "poses":
        return _trackable_objects(layout, place)
    return place.objects(layout.objects)


def _labels(layout: DatasetLayout, place: Place) -> list[str]:
    """Labels of the first mask."""
    if layout.masks is None:
        raise InputError(f"The description {layout.name} takes objects from masks but names none; add masks.")
    first = place.file(layout.masks.files)
    if first is None:
        return []
    labels = np.unique(read_labels(first)).tolist()
    objects = [label for label in labels if label not in (0, VOID)] or [VOID]
    return [str(label) for label in objects if label in labels]


def _trackable_objects(layout: DatasetLayout, place: Place) -> list[str]:
    """Objects of scene_gt.json that no image shows twice."""
    if layout.poses is None or layout.poses.form != "bop":
        raise InputError(
            f"The description {layout.name} takes objects from poses; that needs poses of form bop."
        )
    scene = read_scene_gt(place.required(layout.poses.file, "objects"))
    shown = [[annotation.object_id for annotation in image] for image in scene.values()]
    twice = {each for image in shown for each in image if image.count(each) > 1}
    return [str(each) for each in sorted(set().union(*shown) - twice)]


def _names_in(listing: Path) -> list[str]:
    try:
        lines = listing.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"{listing} cannot be read as text ({error}); restore it.") from error
    return [line.strip() for line in lines if line.strip()]
