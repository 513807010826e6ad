"""The matching test of feature encoders: an image against itself, warped and in another light.

The same place must have the same features, wherever it has moved and whatever the light does. An image is warped
by a known homography and changed by a shading ramp, gamma, a colour cast and noise. For points of the image the
nearest neighbour by cosine is searched among all pixels of the warped one; it counts if it lies within 3 px of
the truth. A search everywhere asks whether features are distinctive, one near the truth whether they are precise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from tracking3d.errors import InputError
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.frames import Image

Encode = Callable[[Tensor], Tensor]
"""From ``(B, 3, H, W)`` RGB in [0, 1] to ``(B, C, h, w)``, as `FeatureEncoder.encode`."""

STRENGTHS = (1 / 3, 2 / 3, 1.0)
"""How strong the warps of one image are, against the strongest."""

TOLERANCE = 3.0
"""Pixels within which a nearest neighbour is right."""

RADIUS = 24.0
"""Pixels around the truth in which the local search looks."""

_POINTS = 256
_MARGIN = 4  # pixels at the border that are neither query nor truth
_TEXTURE = 0.006  # change of grey a pixel, in the direction of least change, over 9 x 9 pixels
_CANDIDATES = 8  # crops of which the one with most texture is taken
_ROTATION, _ZOOM, _PERSPECTIVE = np.radians(20.0), 1.25, 0.25
_SHIFT = 0.25  # of the crop's side; in every warp, since features that encode the image position would do well without
_GAMMA, _SHADING, _CAST, _NOISE = 1.4, 0.5, 0.15, 0.02


@dataclass(frozen=True, eq=False)
class MatchingPair:
    """An image and what a homography and another light make of it."""

    image: Tensor  # (3, S, S) RGB in [0, 1]
    warped: Tensor  # (3, S, S) RGB in [0, 1]
    points: Tensor  # (N, 2) x and y of textured pixels of image, whole numbers
    truth: Tensor  # (N, 2) their positions in warped, in pixels


@dataclass(frozen=True)
class MatchingScores:
    """Shares of points whose nearest neighbour lies within `TOLERANCE` of the truth."""

    everywhere: float  # searched over the whole warped image
    nearby: float  # share if searched within `RADIUS` of the truth
    points: int  # how many points were searched for


def make_pairs(images: Sequence[Image], seed: int = 0, size: int = 256) -> list[MatchingPair]:
    """Cut, warp and relight images: one pair of an image for each of `STRENGTHS`.

    At full strength a warp turns by up to 20 degrees, zooms by up to 1.25 and foreshortens by up to 0.25 over the
    image; every warp shifts by up to a quarter of the crop. Light is always changed in full: gamma 1.4, a ramp of
    gain from 0.5 to 1.5 in any direction, a gain of each channel from 0.85 to 1.15, noise of 0.02.

    Args:
        images: ``(H, W, 3)`` uint8 RGB of any size; large ones are reduced to at most twice ``size`` first.
        seed: Seed of crops, warps, light, noise and points.
        size: Side S of the crops in pixels.

    Returns:
        The pairs that have enough texture.

    Raises:
        InputError: If none has.
    """
    pairs = []
    for number, image in enumerate(images):
        scaled = _rescale(image, size)
        for strength in STRENGTHS:
            rng = np.random.default_rng([seed, number, round(100 * strength)])
            if pair := _make_pair(scaled, size, strength, rng):
                pairs.append(pair)
    if not pairs:
        raise InputError("No image has enough texture to match points in; give photographs.")
    return pairs


def matching_scores(
    encode: Encode, pairs: Sequence[MatchingPair], channels: int | None = None
) -> MatchingScores:
    """Match the points of all pairs.

    Feature maps are interpolated to the images' size and compared by cosine.

    Args:
        encode: The encoder.
        pairs: What `make_pairs` made.
        channels: Reduce features to so many channels, by the principal components of each pair's first image,
            as tracking does inside the first mask.
    """
    errors = torch.cat([_errors(encode, pair, channels) for pair in pairs], dim=1)
    everywhere, nearby = errors.le(TOLERANCE).double().mean(1).tolist()
    return MatchingScores(everywhere, nearby, errors.shape[1])


def _rescale(image: Image, size: int) -> NDArray[np.float32]:
    """The image in [0, 1], its shorter side from ``size`` to twice that."""
    shorter = min(image.shape[:2])
    scale = min(max(shorter, size), 2 * size) / shorter
    height, width = (max(round(scale * length), size) for length in image.shape[:2])
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method).astype(np.float32) / 255


def _make_pair(
    photo: NDArray[np.float32], size: int, strength: float, rng: np.random.Generator
) -> MatchingPair | None:
    textured = _is_textured(photo)
    corners = rng.integers(0, np.array(photo.shape[:2]) - size + 1, (_CANDIDATES, 2)).tolist()
    top, left = max(corners, key=lambda at: np.count_nonzero(_crop(textured, at[0], at[1], size)))
    crop = _crop(photo, top, left, size)
    H = _homography(size, strength, rng)
    into_crop = np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    warped = cv2.warpPerspective(photo, H @ into_crop, (size, size), borderMode=cv2.BORDER_REFLECT_101)
    inner = _crop(textured, top, left, size)[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    points = np.argwhere(inner)[:, ::-1].astype(np.float64) + _MARGIN
    truth = cv2.perspectiveTransform(points[None], H)[0] if len(points) else points
    inside = ((truth >= _MARGIN) & (truth <= size - 1 - _MARGIN)).all(axis=1)
    if np.count_nonzero(inside) < _POINTS:
        return None
    chosen = rng.choice(np.flatnonzero(inside), _POINTS, replace=False)
    return MatchingPair(
        _tensor(crop),
        _tensor(_relit(warped, rng)),
        torch.from_numpy(points[chosen]).long(),
        torch.from_numpy(truth[chosen]),
    )


def _homography(size: int, strength: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """``(3, 3)`` from the crop's pixels to the warped image's, about the centre."""
    turn, zoom, across, down = rng.uniform(0.5, 1, 4) * rng.choice([-1, 1], 4) * strength
    angle, scale = _ROTATION * turn, _ZOOM**zoom
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    similarity = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    perspective = np.eye(3)
    perspective[2, :2] = _PERSPECTIVE * across / size, _PERSPECTIVE * down / size
    centre, moved = np.eye(3), np.eye(3)
    centre[:2, 2] = (size - 1) / 2
    moved[:2, 2] = (size - 1) / 2 + size * rng.uniform(-_SHIFT, _SHIFT, 2)
    return moved @ perspective @ similarity @ np.linalg.inv(centre)


def _crop(image: NDArray, top: int, left: int, size: int) -> NDArray:
    return image[top : top + size, left : left + size]


def _is_textured(photo: NDArray[np.float32]) -> NDArray[np.bool_]:
    """``(H, W)``: pixels around which the image changes in every direction; along an edge no place is known."""
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    derivatives = [cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1))]
    xx, yy, xy = (cv2.blur(derivatives[a] * derivatives[b], (9, 9)) for a, b in ((0, 0), (1, 1), (0, 1)))
    least = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    return least > _TEXTURE**2


def _relit(image: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """The image in another light, as another camera sees it, in 8 bits again."""
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    along = np.cos(angle) * x + np.sin(angle) * y
    ramp = np.interp(along, [along.min(), along.max()], [1 - _SHADING, 1 + _SHADING])
    cast = rng.uniform(1 - _CAST, 1 + _CAST, 3)
    seen = image**_GAMMA * ramp[..., None] * cast + rng.normal(0, _NOISE, image.shape)
    return np.round(np.clip(seen, 0, 1) * 255).astype(np.float32) / 255


def _tensor(image: NDArray[np.float32]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))


def _errors(encode: Encode, pair: MatchingPair, channels: int | None) -> Tensor:
    """``(2, N)`` pixels from the truth to the nearest neighbour everywhere, and nearby."""
    size = pair.image.shape[-1]
    with torch.no_grad():
        first, second = (encode(image[None]).float().cpu() for image in (pair.image, pair.warped))
    if channels is not None and channels < first.shape[1]:
        space = FeatureSpace.of(first[0], torch.ones(first.shape[-2:]), channels)
        first, second = space.project(first[0])[None], space.project(second[0])[None]
    maps = (
        functional.interpolate(one, size=(size, size), mode="bilinear", align_corners=False)
        for one in (first, second)
    )
    wanted, among = (functional.normalize(one[0].flatten(1), dim=0) for one in maps)
    wanted = wanted[:, pair.points[:, 1] * size + pair.points[:, 0]].T
    return torch.cat(list(_search(wanted, among, pair.truth.float(), size)), dim=1)


def _search(wanted: Tensor, among: Tensor, truth: Tensor, size: int) -> Iterator[Tensor]:
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    pixels = torch.stack([columns.flatten(), rows.flatten()], dim=1).float()
    for one, target in zip(wanted.split(64), truth.split(64), strict=True):
        likeness = one @ among
        distance = torch.cdist(target, pixels)
        near = likeness.masked_fill(distance > RADIUS, -torch.inf)
        found = torch.stack([likeness.argmax(1), near.argmax(1)])
        yield distance.expand(2, -1, -1).gather(2, found[..., None])[..., 0]
