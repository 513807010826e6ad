"""What is minimized: the loss of all parameters, paper section 3.3, over one batch of frames."""

from __future__ import annotations

from dataclasses import dataclass, fields

from torch import Tensor
from torch.nn import functional

from tracking3d.config.solvers import LossWeights, PaperConfig
from tracking3d.estimation.observation import ObservationBatch
from tracking3d.estimation.paper import losses
from tracking3d.estimation.shape import Shape
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import Rendering, SoftBand, render, sample_texture, texture_losses


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
        appearance = losses.appearance_loss(
            pixel_loss, drawn.pixels, batch.valid, config.cauchy_scale, seen, config.unseen_penalty or 0.0
        )
        silhouette, target = drawn.silhouette, batch.mask
        if config.silhouette_bias == "erode":
            silhouette = losses.erode(silhouette)
        elif config.silhouette_bias == "soften":
            target = losses.soften(batch.mask, batch.distance, config.sigma)
        smoothed = parameters.offsets
        if config.laplacian_of == "vertices":
            smoothed = smoothed + self.shape.rest
        return Losses(
            appearance,
            losses.iou_loss(silhouette, target, batch.valid) * batch.has_mask,
            losses.distance_loss(silhouette, batch.distance, batch.valid) * batch.has_mask,
            self._motion(parameters) if weights.motion else zero,
            losses.laplacian_loss(self.shape.laplacian, smoothed) if weights.laplacian else zero,
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
        return losses.motion_loss(
            anchor, parameters.poses[-1], frames, config.motion_translation, config.motion_rotation
        )
