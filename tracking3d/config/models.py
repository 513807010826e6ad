"""The settings as pydantic models: every key with its default, range and meaning.

The defaults are those of preset ``default``; ``tracking3d/config/presets`` holds what other presets change.
"""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from tracking3d.config.section import Section
from tracking3d.config.solvers import OnlineConfig, SolverConfig

LARGEST_OBJECT = 1e6
"""Metres that an object's longest side may have; chosen."""
RETRACK_ANGLE = 0.75
"""Degrees; measured on box_in_hand and cube_in_hand."""
MASK_AGREEMENT = 0.97
"""IoU; measured on box_in_hand and cube_in_hand."""
AUTO = "auto"
"""Name of the mask tracker that stands for the best one at hand, see `tracking3d.pipeline.tracker_selection`."""


class PluginChoice(BaseModel):
    """A plug-in by name; every other key is an option of the plug-in, which its own ``Options`` checks."""

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
        None, gt=1, lt=170, description="Vertical field of view in degrees; 45 if nothing better is known."
    )
    intrinsics: tuple[float, float, float, float] | None = Field(
        None,
        description="Focal lengths and principal point fx, fy, cx, cy in pixels of the full frame; overrides fov.",
    )

    distortion: tuple[float, ...] | None = Field(
        None,
        max_length=14,
        description=(
            "Lens distortion coefficients k1, k2, p1, p2, k3 and so on in OpenCV's order. Images are undistorted when "
            "they are read, and masks distorted when they are written."
        ),
    )
    distortion_model: Literal["radtan", "fisheye"] = Field(
        "radtan",
        description="Distortion model: radtan (radial-tangential, OpenCV's default) or fisheye (equidistant).",
    )
    file: str | None = Field(
        None,
        description=(
            "Camera file, instead of intrinsics and distortion: YAML of OpenCV or ROS, Kalibr's camchain, or COLMAP's "
            "cameras.txt."
        ),
    )

    @model_validator(mode="after")
    def _are_said_once(self) -> CameraConfig:
        if self.file is not None and not (self.fov is self.intrinsics is self.distortion is None):
            raise ValueError(
                "give either file, or fov, intrinsics and distortion, because the file has them all"
            )
        return self

    @field_validator("distortion")
    @classmethod
    def _is_of_a_lens(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and not all(map(math.isfinite, value)):
            raise ValueError("give finite numbers k1, k2, p1, p2 and so on")
        return value

    @field_validator("intrinsics")
    @classmethod
    def _are_of_a_camera(
        cls, value: tuple[float, float, float, float] | None
    ) -> tuple[float, float, float, float] | None:
        if value is not None and min(value[:2]) <= 0:
            raise ValueError("give fx, fy, cx, cy with positive focal lengths fx and fy")
        if value is not None and (min(value[:2]) < 1 or max(map(abs, value)) > 1e6):
            raise ValueError("give fx, fy, cx, cy in pixels, from 1 to a million")
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
    extends: str | None = Field(
        None,
        description=(
            "The folder of an earlier run of the same object: at the end of this run the frames of both videos make "
            "its mesh, with the sides that each of them shows."
        ),
    )
    prototype: str = Field(
        "ellipsoid", description="Initial shape: sphere, ellipsoid (fitted to the first mask) or a mesh file."
    )
    frequency: int = Field(11, ge=1, le=40, description="Icosphere frequency f: 10 f^2 + 2 vertices.")
    texture_size: int = Field(150, ge=16, le=2048, description="Side of the feature texture in texels.")
    texture_channels: int | None = Field(
        16,
        ge=1,
        le=512,
        description=(
            "Features with more channels are reduced to this number by a principal component analysis inside the first "
            "mask, and scaled to a common spread; null keeps them unchanged (paper)."
        ),
    )
    adjustment_views: int = Field(
        120,
        ge=0,
        le=2000,
        description=(
            "Most keyframes in the final bundle adjustment of poses, surface and, if not given, focal length. 48 or a "
            "fifth of the frames are taken unless they share too few landmarks. The other frames follow them. 0 "
            "switches the adjustment off."
        ),
    )
    retrack_angle: float = Field(
        RETRACK_ANGLE,
        ge=0,
        description=(
            "With solver.final_refine: a tracked frame keeps its causal estimate if the final bundle adjustment moves "
            "its pose by at most so many degrees against the other frames. 0 estimates every frame again."
        ),
    )
    trust_masks: bool = Field(
        False,
        description=(
            "The initial masks are right: every frame that has one keeps it, and poses and surface are fitted to "
            "it throughout."
        ),
    )
    refine_masks: bool = Field(
        True,
        description=(
            "Segment every frame again at the end of the final refinement, from shape, colour and motion in all frames "
            "together. With trust_masks nothing is segmented again."
        ),
    )
    mask_agreement: float = Field(
        MASK_AGREEMENT,
        gt=0,
        le=1,
        description=(
            "In the final refinement a mask that agrees by more than this IoU with the silhouette and the initial mask "
            "is right: it need not be segmented again, nor its frame be estimated again. 1 does both in all frames."
        ),
    )
    texture_views: int = Field(
        24,
        ge=0,
        le=500,
        description=(
            "Frames that the texture of the mesh is taken from at the resolution of the video, after the final "
            "refinement; 0 keeps the solver's texture, of size texture_size."
        ),
    )
    max_texture_size: int = Field(
        2048, ge=64, le=8192, description="Maximum side of the texture image of the mesh, in texels."
    )
    shape: Literal["auto", "fast", "fine"] = Field(
        "auto",
        description=(
            "Shape of the final mesh: fast takes that of the online map; fine reconstructs it from all frames after "
            "the final refinement, and keeps the result if it explains held-out frames better; auto does "
            "so where that is possible."
        ),
    )
    size: float | None = Field(
        None,
        gt=0,
        le=LARGEST_OBJECT,
        description=(
            "Metres of the object's longest side: of the longest side of the smallest box around what the video has "
            "shown. All lengths of the finished run are then in metres; null leaves the run's arbitrary unit. A known "
            "object has its own unit."
        ),
    )
    flat: bool = Field(
        False, description="Planar object: project all vertices onto one plane after each iteration."
    )

    @property
    def segments_again(self) -> bool:
        """Whether the final refinement segments every frame again."""
        return self.refine_masks and not self.trust_masks

    @model_validator(mode="after")
    def _has_one_unit(self) -> ObjectConfig:
        if self.model is not None and self.size is not None:
            raise ValueError("a known object has its own unit; leave out size, or model")
        if self.model is not None and self.extends is not None:
            raise ValueError(
                "the shape of a known object is fixed and cannot be extended; leave out extends, or model"
            )
        return self

    @model_validator(mode="before")
    @classmethod
    def _is_held_where_known(cls, value: Any) -> Any:
        if isinstance(value, dict) and value.get("model") is not None:
            return {**value, "adjustment_views": 0, "texture_views": 0, "shape": "fast"}
        return value


class CropConfig(Section):
    """The crop of the frame that is rendered and compared."""

    size: int = Field(
        128, ge=32, le=1024, description="Working resolution: side of the square crop in pixels."
    )
    margin: float = Field(
        0.3,
        ge=0.05,
        le=2,
        description="Margin on each side, relative to the longer side of the mask's box.",
    )


class RuntimeConfig(Section):
    """Device, threads, and what a run keeps and tolerates."""

    device: str = Field("cpu", description="cpu, cuda, or cuda:N.")
    seed: int = Field(0, ge=0, lt=2**64, description="Random seed.")
    threads: int = Field(
        1,
        ge=1,
        description=(
            "CPU threads of torch and of the renderer. One is hardly slower than several, and far faster on a busy "
            "machine or if several runs share it. The final bundle adjustment uses as many threads as OpenCV does."
        ),
    )
    renderer: Literal["auto", "torch", "numba"] = Field(
        "auto",
        description="Rendering backend: torch (any device), numba (CPU), or auto, the fastest available.",
    )
    rollback_points: int = Field(
        8,
        ge=0,
        le=64,
        description=(
            "Saved states of earlier frames that a correction can restart from, also after the run has finished; 0 for "
            "none."
        ),
    )
    probabilities: bool = Field(
        False, description="Write the object probability of every pixel too, as 8-bit PNG."
    )
    on_plugin_failure: Literal["continue", "stop"] = Field(
        "continue",
        description=(
            "If a plug-in fails after the first frame: record the reason and continue with the last mask, or stop and "
            "keep the finished frames."
        ),
    )


class PipelineConfig(Section):
    """The whole pipeline."""

    tracker: PluginChoice = PluginChoice(name=AUTO)
    features: PluginChoice = PluginChoice(name="rgb")
    camera: CameraConfig = CameraConfig()
    object: ObjectConfig = ObjectConfig()
    crop: CropConfig = CropConfig()
    solver: SolverConfig = OnlineConfig()
    runtime: RuntimeConfig = RuntimeConfig()

    @field_validator("tracker")
    @classmethod
    def _options_have_an_owner(cls, tracker: PluginChoice) -> PluginChoice:
        """Options without the name of a tracker are those of `segment`, whose network is always there."""
        alone = tracker.name != AUTO or not tracker.options
        return tracker if alone else PluginChoice(name="segment", **tracker.options)

    @property
    def has_given_masks(self) -> bool:
        """Whether the user gives the initial masks of all frames; VOT's text files, mostly of boxes, do not count."""
        path = str(self.tracker.options.get("path", ""))
        return self.tracker.name == "precomputed" and not path.lower().endswith(".txt")
