"""One frame as the solvers see it: features and mask in a window of the one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional

from tracking3d.config.models import PipelineConfig
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.online.features.sift import SIFT, Detector
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Box, Frame
from tracking3d.geometry.camera import Camera, Window, pixel_distance
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import PoseTarget, channels_last, signed_distance

_HULL_SHARE = 0.4  # of the distance to the mask's convex hull behind an occluder (chosen)


@dataclass(frozen=True, eq=False)
class Observation:
    """A window of one frame, ``S`` x ``S`` pixels."""

    index: int  # the frame's index in the source
    window: Window  # where in the frame
    K: Tensor  # (3, 3) the camera's intrinsics in the window
    image: Tensor  # (3, 2 S, 2 S) RGB in [0, 1], finer than the rest: it becomes the visible texture
    features: Tensor  # (C, S, S)
    valid: Tensor  # (S, S) 1 inside the frame, 0 beyond its border, where nothing is known
    mask: Tensor  # (S, S) rough mask in [0, 1]; all zero if there is none
    distance: Tensor  # (S, S) distance to the mask in NDC, zero inside it
    has_mask: bool  # whether the mask tracker gave a mask
    # (S, S) in [0, 1], what is known to be in front of the object; None if nothing is known
    occluder: Tensor | None = None

    @cached_property
    def half(self) -> Observation:
        """At half the working resolution."""
        return downsample(self)

    @cached_property
    def completed_mask(self) -> Tensor:
        """``(S, S)`` the mask in [0, 1], behind an occluder that of its convex hull."""
        if self.occluder is None or not self.has_mask:
            return self.mask
        covered = self.occluder > 0.5
        hull = torch.from_numpy(convex_hull((self.mask > 0.5).cpu().numpy())).to(covered.device)
        return torch.where(hull & covered, 1.0, self.mask)

    @cached_property
    def outline_distance(self) -> Tensor:
        """``(S, S)`` see `tracking3d.estimation.observation.outline_distance`.

        Behind an occluder the outline is that of the mask's convex hull, at a lower weight: a surface that is free
        there grows sheets, and the occluder's outline is not the object's.
        """
        distance = outline_distance(self.completed_mask, self.valid)
        if self.occluder is None or not self.has_mask:
            return distance
        return torch.where(self.occluder > 0.5, _HULL_SHARE * distance, distance)

    @cached_property
    def free_outline_distance(self) -> Tensor:
        """The same, of nothing but the outline that is no occluder's: poses are fitted to it."""
        if self.occluder is None:
            return self.outline_distance
        return outline_distance(self.mask, self.valid * (self.occluder < 0.5))

    @cached_property
    def target(self) -> PoseTarget:
        """What poses are fitted to."""
        # What covers the object, or lies beside it, is left out of the comparison: the mask is to show it.
        return PoseTarget(
            self.K,
            channels_last(self.features[None])[0],
            self.valid * self.mask if self.has_mask else self.valid,
            self.valid > 0.5 if self.occluder is None else (self.valid > 0.5) & (self.occluder < 0.5),
            self.mask > 0.5 if self.has_mask else None,
            self.free_outline_distance if self.has_mask else None,
        )


@dataclass(frozen=True, eq=False)
class ObservationBatch:
    """Several observations stacked: the same fields with a leading ``(B,)``, see `Observation`."""

    index: Tensor
    K: Tensor
    features: Tensor
    valid: Tensor
    mask: Tensor
    distance: Tensor
    has_mask: Tensor

    @classmethod
    def of(cls, observations: list[Observation]) -> ObservationBatch:
        """Stack observations."""
        device = observations[0].features.device
        return cls(
            torch.tensor([o.index for o in observations], device=device),
            torch.stack([o.K for o in observations]),
            channels_last(torch.stack([o.features for o in observations])),
            torch.stack([o.valid for o in observations]),
            torch.stack([o.mask for o in observations]),
            torch.stack([o.distance for o in observations]),
            torch.tensor([float(o.has_mask) for o in observations], device=device),
        )


def observe(
    frame: Frame,
    mask: NDArray[np.bool_] | None,
    window: Window,
    camera: Camera,
    encoder: FeatureEncoder,
    device: torch.device,
) -> Observation:
    """Cut the window out of a frame and encode it."""
    rows, columns, border = _within(window, *frame.size)
    pixels = torch.tensor(np.ascontiguousarray(frame.image[rows, columns]), device=device)
    pixels = _pad(pixels.permute(2, 0, 1).float() / 255, border)
    image, detail = _resample(pixels, window.size), _resample(pixels, 2 * window.size)
    valid = torch.ones(window.size, window.size, device=device)
    if any(border):
        inside = torch.ones(1, rows.stop - rows.start, columns.stop - columns.start, device=device)
        valid = _resample(_pad(inside, border), window.size)[0].ge(0.5).float()
    # Features of a stride above 1 are cut out of the finer image, so as not to be coarser than the rest.
    features = encoder.encode((image if encoder.stride == 1 else detail)[None])
    if features.shape[-1] != window.size:
        features = functional.interpolate(
            features, size=(window.size, window.size), mode="bilinear", antialias=True
        )
    if mask is None or not mask.any():
        soft = distance = torch.zeros_like(valid)
    else:
        there = torch.from_numpy(mask[rows, columns]).to(device).float()
        soft = _resample(_pad(there[None], border), window.size)[0]
        distance = mask_distance(soft)
    K = torch.tensor(window.K(camera), dtype=torch.float32, device=device)
    occluder = None
    if frame.occluder is not None:
        covered = torch.from_numpy(frame.occluder[rows, columns]).to(device).float()
        occluder = _resample(_pad(covered[None], border), window.size)[0]
    known = mask is not None and bool(soft.any())
    return Observation(
        frame.index, window, K, detail, features[0].float(), valid, soft, distance, known, occluder
    )


def downsample(observation: Observation) -> Observation:
    """The same observation at half the working resolution."""
    half = replace(observation.window, size=observation.window.size // 2)
    scale = observation.K.new_tensor([0.5, 0.5, 1.0])
    K = observation.K * scale[:, None]
    K[:2, 2] -= 0.25  # pixel centres stay at integers

    def pool(image: Tensor) -> Tensor:
        return functional.avg_pool2d(image.reshape(1, -1, *image.shape[-2:]), 2)[0].reshape(
            *image.shape[:-2], half.size, half.size
        )

    return replace(
        observation,
        window=half,
        K=K,
        features=pool(observation.features),
        valid=pool(observation.valid).ge(0.75).float(),
        mask=pool(observation.mask),
        distance=pool(observation.distance),
        occluder=None if observation.occluder is None else pool(observation.occluder),
    )


def crop(image: Tensor, window: Window) -> Tensor:
    """Resample ``(C, H, W)`` into the window: ``(C, S, S)``, antialiased, zero beyond the border."""
    rows, columns, border = _within(window, *image.shape[-2:])
    return _resample(_pad(image[:, rows, columns], border), window.size)


def _within(window: Window, height: int, width: int) -> tuple[slice, slice, tuple[int, int, int, int]]:
    """Rows and columns of an image that a window sees, and how far it reaches beyond: left, right, above, below."""
    (columns, *across), (rows, *along) = (
        _span(first, window.side, size) for first, size in ((window.left, width), (window.top, height))
    )
    return rows, columns, (across[0], across[1], along[0], along[1])


def _span(first: int, count: int, size: int) -> tuple[slice, int, int]:
    """What of ``count`` places from ``first`` on lies in ``range(size)``, and how many come before and after it."""
    begin = min(max(first, 0), size)
    end = max(min(first + count, size), begin)
    before = min(max(-first, 0), count)
    return slice(begin, end), before, count - before - (end - begin)


def _pad(image: Tensor, border: tuple[int, int, int, int]) -> Tensor:
    """``(C, H, W)`` with zeros around it; the same if there is no border, which saves a copy."""
    return functional.pad(image, border) if any(border) else image


def _resample(image: Tensor, size: int) -> Tensor:
    """``(C, side, side)`` at ``size`` x ``size`` pixels, antialiased."""
    return functional.interpolate(image[None], size=(size, size), mode="bilinear", antialias=True)[0]


def mask_distance(mask: Tensor) -> Tensor:
    """Distance of every pixel of ``(S, S)`` to the mask, in NDC (half the window's side is 1); 0 for an empty mask.

    The target is constant, so nothing is differentiated through it.
    """
    inside = (mask >= 0.5).cpu().numpy()
    if not inside.any():
        return torch.zeros_like(mask)
    return torch.from_numpy(pixel_distance(inside)).to(mask) * (2.0 / mask.shape[-1])


def projected_box(vertices: Tensor, camera: Camera, pose: Pose) -> Box | None:
    """Box ``(x, y, w, h)`` of the projected vertices inside the frame; None if none is or one is behind."""
    x_cam = vertices @ pose.R.T + pose.translation
    if not bool((x_cam[:, 2] > 1e-3).all()):
        return None
    focal = x_cam.new_tensor([camera.fx, camera.fy])
    pixel = x_cam[:, :2] / x_cam[:, 2:] * focal + x_cam.new_tensor([camera.cx, camera.cy])
    # Of an object right before the camera all but a little lies outside, and could be any number of pixels.
    size = x_cam.new_tensor([camera.width, camera.height])
    low, high = (bound.clamp_min(0.0).minimum(size) for bound in (pixel.amin(0), pixel.amax(0)))
    if not bool((low < high).all()):
        return None
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


def mask_box(mask: NDArray[np.bool_]) -> Box:
    """Box ``(x, y, w, h)`` of a non-empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    left, top = float(columns[0]), float(rows[0])
    return left, top, float(columns[-1] + 1) - left, float(rows[-1] + 1) - top


def convex_hull(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(S, S)`` the convex hull of a mask's pixels; empty if the mask is."""
    hull = np.zeros(mask.shape, np.uint8)
    if mask.any():
        points = np.argwhere(mask)[:, ::-1].astype(np.int32)
        cv2.fillConvexPoly(hull, cv2.convexHull(points), 1)
    return hull > 0


def outline_distance(mask: Tensor, valid: Tensor) -> Tensor:
    """``(S, S)`` signed distance in pixels to the mask's outline, negative inside, zero where nothing is known.

    A mask that the frame's border cuts off goes on beyond it, and one that an occluder cuts off behind that: the cut is
    no outline of the object.

    Args:
        mask: ``(S, S)`` in [0, 1].
        valid: ``(S, S)`` 1 where the mask is known, 0 beyond the frame's border and behind occluders.
    """
    inside = valid > 0.5
    if bool(inside.all()) or not bool(inside.any()):
        return signed_distance(mask[None])[0]
    _, nearest = distance_transform_edt(~inside.cpu().numpy(), return_indices=True)
    row, column = (torch.from_numpy(np.ascontiguousarray(axis)).to(mask.device) for axis in nearest)
    return torch.where(inside, signed_distance(mask[row.long(), column.long()][None])[0], 0.0)


@dataclass(frozen=True)
class Observer:
    """How a frame becomes an observation."""

    config: PipelineConfig  # the pipeline's configuration
    camera: Camera  # the camera of the full frame, as it was known before the first frame
    encoder: FeatureEncoder  # the feature encoder
    detector: Detector = SIFT  # what finds keypoints

    @property
    def device(self) -> torch.device:
        """The device of all tensors."""
        return torch.device(self.config.runtime.device)

    def observe(
        self,
        frame: Frame,
        mask: NDArray[np.bool_] | None,
        pose: Pose,
        vertices: Tensor,
        camera: Camera,
        space: FeatureSpace | None,
    ) -> Observation:
        """Crop a frame around the object and encode the crop.

        Args:
            frame: The frame.
            mask: Mask of the object ``(H, W)``, around which the frame is cropped; None if there is none.
            pose: Expected pose; without a mask the frame is cropped around the object there.
            vertices: Vertices of the object ``(V, 3)``.
            camera: Camera of the frame.
            space: Subspace that features are projected into, if they are.
        """
        box = mask_box(mask) if mask is not None else projected_box(vertices, camera, pose)
        if box is None:
            box = (0.0, 0.0, float(camera.width), float(camera.height))
        window = Window.around(box, self.config.crop.margin, self.config.crop.size)
        observation = observe(frame, mask, window, camera, self.encoder, self.device)
        if space is None:
            return observation
        return replace(observation, features=space.project(observation.features, observation.image))
