"""One image of a whole run: crops from the whole clip, the texture, and views of the model from seen sides."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Image
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.surface import sample_texture
from tracking3d.rendering.visibility import rasterize
from tracking3d.results import drawing
from tracking3d.results.description import own_masks, time_per_frame
from tracking3d.runtime.stage_times import STAGES

TILE = 240
COLUMNS = 6
CROPS = 12
MOST = 2 * CROPS
VIEWS = COLUMNS - 2
"""Views of the model."""
_MARGIN = 0.35  # of the object's longer side, around it
_LETTERS = 11


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """One crop of the overlay, ``(TILE, TILE, 3)``, the estimate's pose, and what is written on it."""

    index: int
    image: Image
    status: Status
    keyframe: bool
    T_cam_obj: NDArray[np.float64]


class Thumbnails:
    """At most `MOST` crops, evenly spread over a clip whose length is not known beforehand.

    Every ``step``-th frame is kept; when there are too many, every other one is dropped and the step doubles.
    """

    def __init__(self) -> None:
        self.kept: list[Thumbnail] = []
        self._step = 1
        self._frames = 0

    def add(self, picture: Image, scale: float, estimate: FrameEstimate) -> None:
        """Offer the next frame's overlay.

        Args:
            picture: ``(H, W, 3)`` overlay without its bar.
            scale: Overlay pixels per frame pixel.
            estimate: The estimate that it shows.
        """
        if self._frames % self._step == 0:
            self.keep(picture, scale, estimate)
        self._frames += 1
        if len(self.kept) > MOST:
            self.kept = self.kept[::2]
            self._step *= 2

    def keep(self, picture: Image, scale: float, estimate: FrameEstimate) -> None:
        """Keep the crop of a frame; for the arguments see `add`."""
        crop = drawing.fit(_around(picture, estimate.mask, scale), TILE)
        self.kept.append(
            Thumbnail(estimate.index, crop, estimate.status, estimate.keyframe, estimate.T_cam_obj)
        )

    def spread(self, count: int) -> list[Thumbnail]:
        """``count`` of them, evenly spread, the first and the last among them."""
        chosen = np.unique(np.linspace(0, len(self.kept) - 1, min(count, len(self.kept))).round().astype(int))
        return [self.kept[i] for i in chosen]


def crop_positions(count: int) -> range:
    """Positions, among so many frames, of those that `Thumbnails` keeps."""
    step = 1
    while len(range(0, count, step)) > MOST:
        step *= 2
    return range(0, count, step)


def draw_contact_sheet(
    thumbnails: Sequence[Thumbnail],
    model: ObjectModel | None,
    run: dict[str, Any],
    replaced: Set[int] = frozenset(),
    earlier: Image | None = None,
) -> Image:
    """Draw the sheet.

    Args:
        thumbnails: Crops in the order of the clip.
        model: The object; None leaves texture and mesh out.
        run: ``run.json`` of the run, as it is at the end.
        replaced: Frames whose crop shows an estimate that is not the last one.
        earlier: A sheet of the same crops, from which these are taken.

    Returns:
        ``(H, COLUMNS * TILE, 3)``.
    """
    tiles = [_add_label(thumbnail, thumbnail.index in replaced) for thumbnail in thumbnails]
    if earlier is not None:
        grid = earlier[: len(earlier) // TILE * TILE].reshape(-1, TILE, COLUMNS, TILE, 3).swapaxes(1, 2)
        tiles = [*grid.reshape(-1, TILE, TILE, 3)[: len(tiles)]]
    tiles += [_blank() for _ in range(-len(tiles) % COLUMNS)]
    if model is not None:
        texture = np.where((model.texture_weight > 0)[..., None], model.texture, model.texture // 3 + 40)
        tiles.append(_add_title(drawing.fit(texture.astype(np.uint8), TILE), "texture (pale: never seen)"))
        views = _views(thumbnails, model)
        tiles += views + [_blank() for _ in range(VIEWS - len(views))]
    tiles.append(_legend(run))
    tiles += [_blank() for _ in range(-len(tiles) % COLUMNS)]
    rows = [np.concatenate(tiles[i : i + COLUMNS], 1) for i in range(0, len(tiles), COLUMNS)]
    return np.concatenate([*rows, _footer(run)], 0)


def _around(picture: Image, mask: NDArray[np.bool_], scale: float) -> Image:
    """The part of ``picture`` around the mask, as square as the frame allows; all of it for an empty mask."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    if not width:
        return picture
    half = scale * max(width, height) * (0.5 + _MARGIN)
    middle = scale * (x + width / 2), scale * (y + height / 2)
    left, right = (int(np.clip(middle[0] + d, 0, picture.shape[1])) for d in (-half, half))
    top, bottom = (int(np.clip(middle[1] + d, 0, picture.shape[0])) for d in (-half, half))
    return picture[top:bottom, left:right] if bottom > top and right > left else picture


def _views(thumbnails: Sequence[Thumbnail], model: ObjectModel) -> list[Image]:
    """The model from the sides that tracked frames show, as different as they are; blank tiles beyond those."""
    middle = (model.vertices.min(0) + model.vertices.max(0)) / 2
    sides = {
        thumbnail.index: rotation
        for thumbnail in thumbnails
        if thumbnail.status is Status.TRACKED
        and (rotation := side_shown(thumbnail.T_cam_obj, middle)) is not None
    }
    if not sides:
        return [_add_title(render_view(model, np.eye(3), TILE), "model")]
    indices = list(sides)
    chosen = most_different(np.stack(list(sides.values())), VIEWS)
    look = look_of(model, TILE)
    return [
        _add_title(render_view(model, sides[index], TILE, look), f"model as in #{index}")
        for index in sorted(indices[one] for one in chosen)
    ]


def _add_label(thumbnail: Thumbnail, replaced: bool) -> Image:
    title = f"#{thumbnail.index} {thumbnail.status.value}" + (", keyframe" if thumbnail.keyframe else "")
    title += ", first estimate" if replaced else ""
    tile = _add_title(thumbnail.image, title, drawing.STATUS[thumbnail.status])
    if thumbnail.keyframe:
        cv2.rectangle(tile, (1, 1), (TILE - 2, TILE - 2), drawing.KEYFRAME, 3)
    return tile


def _add_title(tile: Image, title: str, colour: drawing.Colour = drawing.INK) -> Image:
    tile = tile.copy()
    tile[: 2 * _LETTERS + 2] = tile[: 2 * _LETTERS + 2] // 4
    drawing.draw_text(tile, title, _LETTERS // 2 + 3, _LETTERS * 3 // 2 + 2, _LETTERS, colour)
    return tile


def _legend(run: dict[str, Any]) -> Image:
    tile, counts = _blank(), run["counts"]
    lines = [
        (f"{counts['frames']} frames", drawing.INK),
        *((f"{counts[status.value]} {status.value}", drawing.STATUS[status]) for status in Status),
        (f"{counts['keyframes']} keyframes", drawing.KEYFRAME),
        ("estimated outline", drawing.REFINED),
        ("mask tracker's outline", drawing.INITIAL),
        *((text, drawing.INK) for text in _of_masks(run)),
    ]
    for row, (text, colour) in enumerate(lines):
        drawing.draw_text(tile, text, 16, 30 + row * 23, _LETTERS, colour)
    return tile


def _of_masks(run: dict[str, Any]) -> list[str]:
    """How many masks are the solver's instead of the initial mask, and their IoU with it."""
    own, iou = own_masks(run), run["iou_initial_mean_own"]
    if own is None:
        return []
    nearness = f"IoU with initial masks {iou:.3f}" if iou is not None else "no initial masks to compare"
    return [f"{own} masks of the solver", *([nearness] if own else [])]


def _footer(run: dict[str, Any]) -> Image:
    """Lines of text across the sheet: the time of a frame, and what one should know."""
    whole, stages = time_per_frame(run)
    lines = []
    if whole is not None:
        parts = [f"{name} {getattr(stages, name):.3f}" for name in STAGES] if stages else []
        lines.append((": ".join(filter(None, (f"{whole:.3f} s per frame", ", ".join(parts)))), drawing.INK))
    lines += [(f"Note: {note}", drawing.STATUS[Status.UNCERTAIN]) for note in run.get("notes", ())]
    band = np.full((23 * len(lines) + 16 * bool(lines), COLUMNS * TILE, 3), drawing.PAPER, dtype=np.uint8)
    for row, (text, colour) in enumerate(lines):
        drawing.draw_text(band, text, 16, 19 + row * 23, _LETTERS, colour)
    return band


def _blank() -> Image:
    return np.full((TILE, TILE, 3), drawing.PAPER, dtype=np.uint8)


_BACKGROUND = 40.0
_UNSEEN = 165.0
_AMBIENT, _AMBIENT_UNSEEN = 0.45, 0.75  # unseen surface stays pale even if it faces away
_DISTANCE = 4.0  # of the camera, in radii of the object
_FILL = 0.8  # of the picture's side
_FINEST = 4  # texels of a texture's side for a pixel of the picture's


def side_shown(T_cam_obj: NDArray[np.float64], middle: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """``(3, 3)`` rotation that shows the object, moved to the middle of the picture, from the side a frame shows.

    Args:
        T_cam_obj: ``(4, 4)``; the ray to the object is turned to the camera's axis.
        middle: ``(3,)`` the object's middle.

    Returns:
        None if the pose is no number, or the object not before the camera.
    """
    if not np.isfinite(T_cam_obj).all():
        return None
    ray = T_cam_obj[:3, :3] @ middle + T_cam_obj[:3, 3]
    if not ray[2] > 0:
        return None
    axis = np.array([ray[1], -ray[0], 0.0])  # the ray's cross product with the camera's axis
    sine = float(np.linalg.norm(axis))
    if sine > 0:
        axis *= math.atan2(sine, ray[2]) / sine
    rotation: NDArray[np.float64] = Rotation.from_rotvec(axis).as_matrix() @ T_cam_obj[:3, :3]
    return rotation


def most_different(rotations: NDArray[np.float64], count: int) -> list[int]:
    """Which of ``(N, 3, 3)`` rotations to show: the first, and always the one that is the furthest from all before."""
    chosen = [0]
    nearness = np.full(len(rotations), -np.inf)
    while len(chosen) < min(count, len(rotations)):
        # The trace of the relative rotation falls as the angle grows.
        nearness = np.maximum(nearness, np.einsum("nij,ij->n", rotations, rotations[chosen[-1]]))
        nearness[chosen] = np.inf
        chosen.append(int(nearness.argmin()))
    return chosen


Look = tuple[Tensor, NDArray[np.float64]]
"""What views of an object share, see `look_of`."""


def look_of(model: ObjectModel, size: int) -> Look:
    """The texture that views of a size sample ``(4, H, W)``: the colour of what was seen, and how much of it was. And
    the normals ``(V, 3)``.

    Args:
        model: The object.
        size: Side of the views in pixels; a texture that is much finer is averaged.
    """
    import trimesh  # slow to import

    seen = (model.texture_weight > 0)[..., None]
    layers = np.concatenate([model.texture * seen, seen], axis=2, dtype=np.float32)
    while min(layers.shape[:2]) >= _FINEST * size:
        layers = cv2.resize(
            layers, (layers.shape[1] // 2, layers.shape[0] // 2), interpolation=cv2.INTER_AREA
        )
    normals = trimesh.Trimesh(model.vertices, model.faces, process=False).vertex_normals
    return torch.tensor(np.ascontiguousarray(layers.transpose(2, 0, 1))), np.asarray(normals)


def render_view(
    model: ObjectModel, rotation: NDArray[np.float64], size: int, look: Look | None = None
) -> Image:
    """Draw the whole object, lit from the camera, into a square picture ``(size, size, 3)``.

    Texels that were never seen are of a pale grey.

    Args:
        model: The object.
        rotation: ``(3, 3)`` object to camera.
        size: Side in pixels.
        look: See `look_of`; made here if left out. Several views of one object share it.
    """
    texture, normals = look_of(model, size) if look is None else look
    low, high = model.vertices.min(0), model.vertices.max(0)
    centred = (model.vertices - (low + high) / 2) @ rotation.T
    radius = max(float(np.linalg.norm(centred, axis=1).max()), 1e-12)
    points = centred / radius + (0.0, 0.0, _DISTANCE)
    focal = 0.5 * _FILL * size * math.sqrt(_DISTANCE**2 - 1)
    screen = torch.tensor(focal * points[:, :2] / points[:, 2:] + (size - 1) / 2, dtype=torch.float32)[None]
    depth = torch.tensor(points[:, 2], dtype=torch.float32)[None]
    faces = torch.tensor(model.faces)
    face_index = rasterize(screen, depth, faces, (size, size)).face_index

    normals = normals @ rotation.T
    corners = np.concatenate([model.face_uvs, normals[model.faces], centred[model.faces] / radius], axis=2)
    uv, normal, at = interpolate(
        screen, depth, faces, torch.tensor(corners, dtype=torch.float32), face_index
    ).split([2, 3, 3], dim=1)
    colour, weight = sample_texture(texture, uv).split([3, 1], dim=1)
    ambient = weight * _AMBIENT + (1 - weight) * _AMBIENT_UNSEEN
    colour = colour + (1 - weight) * _UNSEEN
    to_camera = torch.nn.functional.normalize(
        torch.tensor([0.0, 0.0, -_DISTANCE], dtype=at.dtype) - at, dim=1
    )
    facing = (torch.nn.functional.normalize(normal, dim=1) * to_camera).sum(1, keepdim=True).clamp(0, 1)
    picture = torch.full((size, size, 3), _BACKGROUND, dtype=colour.dtype)
    picture[face_index[0] >= 0] = colour * (ambient + (1 - ambient) * facing)
    result: Image = picture.round().clamp(0, 255).to(torch.uint8).numpy()
    return result
