"""What can be configured, as pydantic models: every key, its default, its range and what it means.

The defaults are those of preset ``default``; ``tracking3d/config/presets`` holds what other presets change.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from tracking3d.config.section import Section
from tracking3d.config.solvers import OnlineConfig, SolverConfig


class PluginChoice(BaseModel):
    """A plug-in by name; every other key is an option of the plug-in and checked by its own ``Options``."""

    model_config = ConfigDict(extra="allow", frozen=True)

    name: str = Field(description="Name of the plug-in, as `tracking3d plugins` lists it.")

    @model_validator(mode="before")
    @classmethod
    def _name_alone(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @property
    def options(self) -> dict[str, Any]:
        """The plug-in's own options."""
        return dict(self.model_extra or {})


class CameraConfig(Section):
    """The camera of the full frame."""

    fov: float | None = Field(
        None, gt=1, lt=170, description="Vertical field of view in degrees; 45 when nothing better is known."
    )
    intrinsics: tuple[float, float, float, float] | None = Field(
        None, description="fx, fy, cx, cy in pixels of the full frame; wins over fov."
    )

    distortion: tuple[float, ...] | None = Field(
        None,
        max_length=14,
        description=(
            "k1, k2, p1, p2, k3 and so on of the lens, as OpenCV has them; pictures are undistorted on the way in, and "
            "masks distorted on the way out."
        ),
    )
    distortion_model: Literal["radtan", "fisheye"] = Field(
        "radtan", description="What distortion is of: radtan (OpenCV's usual one) or fisheye (equidistant)."
    )
    file: str | None = Field(
        None,
        description=(
            "Camera file instead of intrinsics and distortion: OpenCV's or ROS's YAML, Kalibr's camchain, or COLMAP's "
            "cameras.txt."
        ),
    )

    @model_validator(mode="after")
    def _are_said_once(self) -> CameraConfig:
        if self.file is not None and not (self.fov is self.intrinsics is self.distortion is None):
            raise ValueError("file, or fov, intrinsics and distortion, since the file says both")
        return self

    @field_validator("distortion")
    @classmethod
    def _is_of_a_lens(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and not all(map(math.isfinite, value)):
            raise ValueError("finite numbers k1, k2, p1, p2 and so on")
        return value

    @field_validator("intrinsics")
    @classmethod
    def _are_of_a_camera(
        cls, value: tuple[float, float, float, float] | None
    ) -> tuple[float, float, float, float] | None:
        if value is not None and min(value[:2]) <= 0:
            raise ValueError("fx, fy, cx, cy with positive focal lengths fx and fy")
        if value is not None and (min(value[:2]) < 1 or max(map(abs, value)) > 1e6):
            raise ValueError("fx, fy, cx, cy in pixels, which are from 1 to a million")
        return value


class ObjectConfig(Section):
    """How the object is represented (paper section 3.1)."""

    model: str | None = Field(
        None,
        description=(
            "The folder of an earlier run or a mesh file: the object is that one, and is found in the video without an "
            "initialization by motion. Shape and colours are kept: adjustment_views and texture_views are 0, shape is "
            "fast, and prototype is ignored."
        ),
    )
    prototype: str = Field(
        "ellipsoid", description="sphere, ellipsoid (fitted to the first mask) or a mesh file."
    )
    frequency: int = Field(11, ge=1, le=40, description="Icosphere frequency f: 10 f^2 + 2 vertices.")
    texture_size: int = Field(150, ge=16, le=2048, description="Side of the feature texture in texels.")
    texture_channels: int | None = Field(
        16,
        ge=1,
        le=512,
        description=(
            "Features with more channels are reduced to so many by a principal component analysis inside the "
            "first mask, and given one spread; empty keeps them as they are (paper)."
        ),
    )
    adjustment_views: int = Field(
        120,
        ge=0,
        le=2000,
        description=(
            "Frames whose poses, lens (where nobody gave it) and surface are put right by points, at the end of the "
            "final refinement; the others follow them. 0 leaves them as rendering has them."
        ),
    )
    refine_masks: bool = Field(
        True,
        description=(
            "Masks are weighed once more, against the image, at the end of the final refinement: by shapes, colours "
            "and motion in all frames together."
        ),
    )
    texture_views: int = Field(
        24,
        ge=0,
        le=500,
        description=(
            "Frames that the mesh's texture is taken from at the video's resolution, after the final refinement; "
            "0 leaves the solver's, of texture_size."
        ),
    )
    max_texture_size: int = Field(
        2048, ge=64, le=8192, description="Most texels along a side of the mesh's texture."
    )
    shape: Literal["fast", "fine"] = Field(
        "fast",
        description=(
            "The shape of the mesh at the end: the online map's, or fine, made anew from all frames after the final "
            "refinement and kept where it explains frames that were left out better (extra model)."
        ),
    )
    flat: bool = Field(
        False, description="Flat prior: project all vertices onto one plane after each iteration."
    )

    @model_validator(mode="before")
    @classmethod
    def _is_held_where_known(cls, value: Any) -> Any:
        if isinstance(value, dict) and value.get("known") is not None:
            return {**value, "adjustment_views": 0, "texture_views": 0, "shape": "fast"}
        return value


class CropConfig(Section):
    """The window of the frame that is rendered."""

    size: int = Field(128, ge=32, le=1024, description="Working resolution: side of the window in pixels.")
    margin: float = Field(
        0.3,
        ge=0.05,
        le=2,
        description="Free space on each side, relative to the longer side of the mask's box.",
    )


class RuntimeConfig(Section):
    """Where and how it runs."""

    device: str = Field("cpu", description="cpu, cuda, or cuda:N.")
    seed: int = Field(0, ge=0, lt=2**64, description="Seed of everything random.")
    threads: int = Field(
        1,
        ge=1,
        description=(
            "CPU threads of torch and of the renderer. One is never much slower here, and far faster on a busy "
            "machine or when several runs share one. What is bundled at the end of a final refinement takes as many as "
            "OpenCV has."
        ),
    )
    renderer: Literal["auto", "torch", "numba"] = Field(
        "auto",
        description="What renders: torch everywhere, numba on the CPU, or the fastest that can be used here.",
    )
    rollback_points: int = Field(
        8,
        ge=0,
        le=64,
        description=(
            "States of earlier frames that are kept for corrections to go on from, also when the run is finished; "
            "0 for none."
        ),
    )
    probabilities: bool = Field(
        False, description="Write the object's probability in every pixel beside the masks, as 8-bit PNG."
    )
    on_plugin_failure: Literal["continue", "stop"] = Field(
        "continue",
        description=(
            "When a plug-in fails after the first frame: record why and go on with the last mask, or stop and keep "
            "what is finished."
        ),
    )


class PipelineConfig(Section):
    """The whole pipeline."""

    tracker: PluginChoice = PluginChoice(name="csrt")
    features: PluginChoice = PluginChoice(name="rgb")
    camera: CameraConfig = CameraConfig()
    object: ObjectConfig = ObjectConfig()
    crop: CropConfig = CropConfig()
    solver: SolverConfig = OnlineConfig()
    runtime: RuntimeConfig = RuntimeConfig()
