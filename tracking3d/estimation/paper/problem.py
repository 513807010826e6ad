"""What is minimized: the loss of all parameters, paper section 3.3, over one batch of frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from tracking3d.config.models import LossWeights, PaperConfig
from tracking3d.estimation.observation import ObservationBatch
from tracking3d.estimation.shape import Shape, flatten
from tracking3d.geometry.pose import Pose, rotation_angle
from tracking3d.rendering import Rendering, SoftBand, channels_last, render, sample_texture, texture_losses


@dataclass(frozen=True, eq=False)
class Parameters:
    """Everything that is estimated."""

    translation: Tensor  # (B, 3) of each frame's T_cam_obj
    quaternion: Tensor  # (B, 4) of each frame's T_cam_obj, w first
    offsets: Tensor  # (V, 3) from the prototype
    texture: Tensor  # (C, T, T) feature texture; fastest with its channels side by side in memory

    @property
    def poses(self) -> Pose:
        """All poses as one batch."""
        return Pose(self.translation, self.quaternion)

    def detach(self) -> Parameters:
        """A copy without gradients, quaternions brought back to unit length."""
        return Parameters(
            self.translation.detach().clone(),
            functional.normalize(self.quaternion.detach(), dim=1),
            self.offsets.detach().clone(),
            self.texture.detach().clone(),
        )


@dataclass(frozen=True, eq=False)
class Losses:
    """The unweighted loss terms: ``(B,)`` for those with frames, scalars for the others."""

    features: Tensor
    silhouette: Tensor
    distance: Tensor
    motion: Tensor
    laplacian: Tensor
    total_variation: Tensor

    def total(self, weights: LossWeights) -> Tensor:
        """The weighted sum, frames averaged (``mu_n`` of eq. 1 and 2)."""
        return (
            weights.features * self.features.mean()
            + weights.silhouette * (self.silhouette.mean() + weights.distance * self.distance.mean())
            + weights.motion * self.motion
            + weights.laplacian * self.laplacian
            + weights.total_variation * self.total_variation
        )

    def detach(self) -> Losses:
        """A copy without gradients."""
        return Losses(*(getattr(self, field.name).detach() for field in fields(self)))

    def of_frame(self, position: int) -> dict[str, float]:
        """All terms by name, those with frames for one frame."""
        values = ((field.name, getattr(self, field.name)) for field in fields(self))
        named = {name: float(value[position] if value.dim() else value) for name, value in values}
        return {"appearance": named.pop("features"), **named}


@dataclass(frozen=True, eq=False)
class Problem:
    """One batch of frames to explain."""

    shape: Shape  # the object's fixed part
    batch: ObservationBatch  # the frames in order of time, the current one last
    config: PaperConfig  # constants and weights
    # (1, T, T) how far each texel is known, in [0, 1]; None if that makes no difference
    seen: Tensor | None = None
    # Where eq. 3 measures motion from: pose and frame index of the last keyframe. None takes it from the
    # batch's last but one frame; there is no motion term if there is none.
    previous: tuple[Pose, int] | None = None
    backend: str = "auto"  # which renderer, see `tracking3d.rendering.backend`

    def rendering(self, parameters: Parameters) -> Rendering:
        """Render all frames."""
        config = self.config
        return render(
            self.shape.rest + parameters.offsets,
            self.shape.faces,
            self.shape.face_uvs,
            parameters.texture,
            parameters.poses.R,
            parameters.translation,
            self.batch.K,
            (self.batch.mask.shape[1], self.batch.mask.shape[2]),
            SoftBand(config.sigma, config.boxlen, config.knum),
            self.backend,
        )

    def losses(self, parameters: Parameters) -> Losses:
        """Evaluate every term that has a weight."""
        config, weights, batch = self.config, self.config.weights, self.batch
        drawn = self.rendering(parameters)
        zero = drawn.silhouette.new_zeros(())
        seen = None
        if self.seen is not None and config.unseen_penalty is not None:
            seen = sample_texture(self.seen, drawn.uv.detach())[:, 0]
        pixel_loss, total_variation = texture_losses(
            parameters.texture,
            drawn.uv,
            batch.features,
            drawn.pixels,
            config.cauchy_scale,
            total_variation=bool(weights.total_variation and parameters.texture.requires_grad),
            backend=self.backend,
        )
        appearance = appearance_loss(
            pixel_loss, drawn.pixels, batch.valid, config.cauchy_scale, seen, config.unseen_penalty or 0.0
        )
        silhouette, target = drawn.silhouette, batch.mask
        if config.silhouette_bias == "erode":
            silhouette = erode(silhouette)
        elif config.silhouette_bias == "soften":
            target = soften(batch.mask, batch.distance, config.sigma)
        smoothed = parameters.offsets
        if config.laplacian_of == "vertices":
            smoothed = smoothed + self.shape.rest
        return Losses(
            appearance,
            iou_loss(silhouette, target, batch.valid) * batch.has_mask,
            distance_loss(silhouette, batch.distance, batch.valid) * batch.has_mask,
            self._motion(parameters) if weights.motion else zero,
            laplacian_loss(self.shape.laplacian, smoothed) if weights.laplacian else zero,
            total_variation,
        )

    def _motion(self, parameters: Parameters) -> Tensor:
        index = self.batch.index
        if self.previous is not None:
            anchor, since = self.previous
        elif len(index) > 1:
            anchor, since = parameters.poses[-2], int(index[-2])
        else:
            return parameters.translation.new_zeros(())
        frames = max(int(index[-1]) - since, 1)
        config = self.config
        return motion_loss(
            anchor, parameters.poses[-1], frames, config.motion_translation, config.motion_rotation
        )


# The loss terms of the paper (section 3.3), each for itself and for every frame where it has frames.
#
# Silhouettes, masks and distances are ``(B, H, W)``; ``valid`` is 0 beyond the frame's border, where nothing is
# known and nothing is charged.

_SMALL = 1e-10


def appearance_loss(
    pixel_loss: Tensor,
    pixels: Tensor,
    valid: Tensor,
    scale: float,
    seen: Tensor | None = None,
    unseen_penalty: float = 0.0,
) -> Tensor:
    """Appearance loss, eq. 1, for each frame: the mean Cauchy loss over the object's visible pixels.

    The mean over the object makes the threshold tau independent of the window; over the whole window, where most
    pixels are zero, 0.2 would be reached before anything has moved.

    Only covered pixels take part: there the soft silhouette is 1, so the factor ``R_S`` of eq. 1 is exact, and
    an empty texture beyond the outline is not compared with the background.

    Args:
        pixel_loss: ``(P,)`` Cauchy loss at the covered pixels, from `tracking3d.rendering.texture_losses`.
        pixels: ``(P,)`` flat indices of the covered pixels in ``(B, H, W)``, rising.
        valid: ``(B, H, W)``.
        scale: Scale of the Cauchy loss (0.25).
        seen: ``(P,)`` how far the texture at each covered pixel is known, in [0, 1]; all known if None.
        unseen_penalty: What an unknown pixel costs instead.

    Returns:
        ``(B,)``; where nothing is covered, the cost of a residual of 1.
    """
    batch, height, width = valid.shape
    firsts = torch.arange(batch + 1, device=pixels.device) * (height * width)
    lengths = torch.searchsorted(pixels, firsts).diff()  # pixels of each frame
    loss = pixel_loss
    if seen is not None:
        loss = seen * loss + (1 - seen) * unseen_penalty
    weight = valid.reshape(-1).index_select(0, pixels)
    total, count = (torch.segment_reduce(part, "sum", lengths=lengths) for part in (loss * weight, weight))
    # Were it zero, the cheapest pose would be out of sight, and the stopping rule satisfied there.
    nothing = math.log1p(1 / scale**2)
    return torch.where(count > 0, total / count.clamp_min(1.0), nothing)


def iou_loss(silhouette: Tensor, mask: Tensor, valid: Tensor) -> Tensor:
    """First term of the silhouette loss, eq. 2: one minus the soft intersection over union, ``(B,)``."""
    mask = mask * valid
    intersection = _inner(silhouette, mask)
    union = _inner(silhouette, valid) + mask.sum((1, 2)) - intersection
    return 1 - intersection / (union + _SMALL)


def distance_loss(silhouette: Tensor, distance: Tensor, valid: Tensor) -> Tensor:
    """Second term of the silhouette loss, eq. 2: mean distance of silhouette pixels to the mask, ``(B,)``."""
    return _inner(silhouette, distance * valid) / _inner(silhouette, valid).clamp_min(1.0)


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """Inner product of images ``(B, H, W)`` for each frame."""
    return (a * b).sum((1, 2))


def erode(silhouette: Tensor) -> Tensor:
    """3 x 3 erosion, as the reference applies it to the soft silhouette ``(B, H, W)``."""
    # A minimum filter; with its gradient, kornia takes four to fourteen times as long: history/pages/kornia.md.
    return -functional.max_pool2d(-silhouette[:, None], 3, 1, 1)[:, 0]


def soften(mask: Tensor, distance: Tensor, sigma: float) -> Tensor:
    """The target ``(B, H, W)`` with the same soft band as the silhouette: ``exp(-sigma d^2)`` outside."""
    # The silhouette's d ends at the outline, on average half a pixel short of the mask's nearest pixel centre.
    to_outline = (distance - 1.0 / mask.shape[-1]).clamp_min(0.0)
    return torch.maximum(mask, torch.exp(-sigma * to_outline.square()) * (distance > 0))


def motion_loss(
    keyframe: Pose, current: Pose, frames: int, free_translation: float, free_rotation: float
) -> Tensor:
    """Motion regularization, eq. 3: motion a frame since the last keyframe beyond what is free.

    Args:
        keyframe: Pose of the most recent keyframe.
        current: Pose of the current frame.
        frames: Number of frames between them (the paper's sign of this difference is a slip).
        free_translation: Object units a frame (0.1).
        free_rotation: Degrees a frame (30).
    """
    translation = torch.linalg.vector_norm(current.translation - keyframe.translation) / frames
    rotation = rotation_angle(keyframe.quaternion, current.quaternion) / frames
    return functional.relu(translation - free_translation) + functional.relu(
        rotation - math.radians(free_rotation)
    )


def laplacian_loss(laplacian: Tensor, vertices: Tensor) -> Tensor:
    """Laplacian shape regularization (SoftRas): mean squared length of ``L v``."""
    return torch.sparse.mm(laplacian, vertices).square().sum(1).mean()


Free = Literal["all", "pose"]


@dataclass(frozen=True, eq=False)
class Optimum:
    """The result of an optimization."""

    # the estimate: the best state so far, or the initial one if the optimization failed numerically
    parameters: Parameters
    losses: Losses  # the terms at the estimate
    total: float  # their weighted sum
    iterations: int  # number of evaluations
    reason: str = ""  # empty, or why there is no usable estimate


def optimize(
    problem: Problem,
    start: Parameters,
    *,
    iterations: int,
    tau: float,
    fixed: int = 0,
    free: Free = "all",
) -> Optimum:
    """Minimize the problem's total loss.

    Args:
        problem: What to explain.
        start: The initial parameters.
        iterations: Most evaluations.
        tau: Appearance loss at which the paper's rule (``stop: threshold``) ends.
        fixed: Number of leading frames whose pose does not move: the gauge.
        free: ``"pose"`` leaves shape and texture as they are.
    """
    config, rates = problem.config, problem.config.learning_rates
    translation, quaternion = start.translation[fixed:].clone(), start.quaternion[fixed:].clone()
    offsets, texture = start.offsets.clone(), channels_last(start.texture).clone()
    groups = [(translation, rates.translation), (quaternion, rates.rotation)]
    if free == "all":
        groups += [(offsets, rates.vertices), (texture, rates.texture)]
    groups = [(tensor, rate) for tensor, rate in groups if tensor.numel()]
    for tensor, _ in groups:
        tensor.requires_grad_()
    adam = torch.optim.Adam([{"params": [tensor], "lr": rate} for tensor, rate in groups])

    best: Optimum | None = None
    progressed = 0
    for iteration in range(1, iterations + 1):
        parameters = Parameters(
            torch.cat([start.translation[:fixed], translation]),
            torch.cat([start.quaternion[:fixed], quaternion]),
            offsets,
            texture,
        )
        losses = problem.losses(parameters)
        total = losses.total(config.weights)
        value = float(total.detach())
        if not torch.isfinite(total):
            return _numerical_failure(best, start, losses, value, iteration)
        if config.stop == "threshold":
            converged = float(losses.features.detach().mean()) < tau
            if converged or iteration == iterations:
                return Optimum(parameters.detach(), losses.detach(), value, iteration)
        elif best is None or value < best.total:
            # The initial parameters count as progress only once: an unmoved pose never wins by being first.
            if best is None or value < best.total - 1e-4 * abs(best.total):
                progressed = iteration
            best = Optimum(parameters.detach(), losses.detach(), value, iteration)
        elif iteration - progressed >= config.patience:
            break
        adam.zero_grad(set_to_none=True)
        total.backward()
        adam.step()
        if problem.shape.flat and free == "all":
            with torch.no_grad():
                offsets.copy_(flatten(problem.shape.rest + offsets) - problem.shape.rest)
    assert best is not None
    return replace(best, iterations=iteration)


def _numerical_failure(
    best: Optimum | None, start: Parameters, losses: Losses, value: float, iteration: int
) -> Optimum:
    reason = f"the loss became {value} in iteration {iteration}"
    if best is not None:
        return replace(best, iterations=iteration, reason=reason)
    return Optimum(start, losses.detach(), value, iteration, reason)
