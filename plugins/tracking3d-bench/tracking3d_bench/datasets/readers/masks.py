"""A folder of mask images, one a frame: DAVIS results, or any segmentation tool's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.trackers.mask_images import ImageMasks, UnreadableMaskError, natural_key
from tracking3d.video.image_sequence import images_among
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.masks import IndexedMask
from tracking3d_bench.datasets.truth import Truth


@dataclass(frozen=True)
class ObjectImage:
    """A mask image of any kind, see `tracking3d.trackers.mask_images.ImageMasks`.

    Attributes:
        path: The image.
    """

    path: Path

    def read(self) -> NDArray[np.bool_]:
        """See `tracking3d_bench.datasets.truth.MaskReference.read`."""
        try:
            mask = ImageMasks(self.path, [self.path]).read(0)
        except (InputError, UnreadableMaskError) as error:
            raise InputError(
                f"The mask {self.path} is not a readable image; restore or remove it."
            ) from error
        assert mask is not None  # there is one file
        return mask


def answers_from_masks(folder: Path, truth: Truth, object_id: int | None = None) -> Answers:
    """Masks by the names of their frames, without suffix; numbers in names count as numbers, so 7 is 0007.

    Args:
        folder: Folder of the images, or of one folder a clip, as DAVIS has its results.
        truth: The clip.
        object_id: Which object of indexed images; every object if None.

    Raises:
        InputError: If there is no folder, no image has the name of a frame, or two have the same.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}; give the folder of the masks.")
    files = images_among(folder.iterdir())
    if not files and (folder / truth.name).is_dir():
        files = images_among((folder / truth.name).iterdir())
    index = {natural_key(name): n for n, name in enumerate(truth.names)}
    found: dict[int, Path] = {}
    for file in files:
        n = index.get(natural_key(file.stem))
        if n is None:
            continue
        if n in found:
            raise InputError(f"Both {found[n]} and {file} are masks of frame {truth.names[n]}; remove one.")
        found[n] = file
    if not found:
        raise InputError(
            f"{folder} has no mask image with the name of a frame of the clip {truth.name}, such as "
            f"{truth.names[0]}.png; rename them."
        )
    return Answers(
        origin=folder,
        asked=range(len(truth.frames)),
        answered=frozenset(found),
        given=0,
        masks={
            n: ObjectImage(file) if object_id is None else IndexedMask(file, object_id)
            for n, file in found.items()
        },
    )
