"""The specification of a synthetic sequence: object, motion, camera, disturbances and seed.

One `SequenceSpec` always gives the same sequence. Every random choice draws from its own stream of the seed, so
that switching one disturbance on or off leaves all else as it is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, field_validator, model_validator

from tracking3d.config.explain import describe_validation_error
from tracking3d.config.models import Section
from tracking3d.errors import InputError

Strength = Annotated[float, Field(ge=0, le=1)]
"""0 is off, 1 is strongest."""

Motion = Literal[
    "tumble",
    "turntable",
    "turn_and_back",
    "flip",
    "fast",
    "depth_drift",
    "leave_and_return",
    "walk_round",
    "pick_up",
]
"""See `tracking3d_bench.synthesis.motions`; at ``walk_round`` the camera moves, round a still object in a room.

At ``pick_up``, see `tracking3d_bench.synthesis.pick_up`, a hand takes the object from a table.
"""

OWN_BACKGROUND = ("walk_round", "pick_up")
"""Motions whose background is part of the scene: a room or a table."""

PROCEDURAL_BACKGROUND = "procedural"


class Disturbances(Section):
    """What makes a sequence hard; each with a strength from 0 (off) to 1."""

    light: Strength = Field(0.0, description="Direction, brightness and colour of the light change.")
    highlights: Strength = Field(0.0, description="Specular highlights on the object.")
    motion_blur: Strength = Field(
        0.0, description="Share of the frame interval during which the shutter is open."
    )
    noise: Strength = Field(
        0.0, description="Sensor noise; 1 is a standard deviation of about 20 grey levels."
    )
    low_contrast: Strength = Field(0.0, description="Grey levels shrink towards the mean, at 1 to a fifth.")
    occluder: Strength = Field(
        0.0,
        description="A hand moves over the object, or holds it with `pick_up`; at 1 it hides up to 35 % of it.",
    )
    wrong_fov: Strength = Field(
        0.0,
        description="The camera given to a tracker has a wider field of view, at 1 twice the true one.",
    )
    jpeg: Strength = Field(
        0.0, description="JPEG compression: quality 95 near 0, 15 at 1; 0 is lossless PNG."
    )


class SequenceSpec(Section):
    """One synthetic sequence."""

    name: str = Field("sequence", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", description="Name of its folder.")
    object: str = Field("box", min_length=1, description="A procedural object, or a mesh file.")
    textured: bool = Field(True, description="Printed with patterns, or nearly a single colour.")
    print_strength: float = Field(
        1.0,
        ge=0,
        le=1,
        description="Contrast of the print against its mean colour; 0 is that colour alone.",
    )
    label: bool = Field(
        False, description="One small printed label on a procedural object that is plain otherwise."
    )
    motion: Motion = Field("tumble", description="Motion of the object.")
    degrees_per_frame: float = Field(
        4.0,
        ge=0,
        le=60,
        description="Speed of rotation; the peak for `fast`, the mean while it turns for `pick_up`.",
    )
    still_frames: int = Field(
        8, ge=0, le=10_000, description="Frames before the hand comes, at most half; only with `pick_up`."
    )
    frames: int = Field(40, ge=1, le=10_000, description="Number of frames.")
    size: tuple[int, int] = Field((320, 240), description="Width and height in pixels.")
    fov: float = Field(45.0, ge=5, le=100, description="True vertical field of view in degrees.")
    camera_told: bool = Field(True, description="Whether a tracker is given the camera.")
    fill: float = Field(
        0.7,
        ge=0.1,
        le=0.9,
        description="The object's largest diameter relative to the image height, frame 0.",
    )
    background: str = Field(
        PROCEDURAL_BACKGROUND, min_length=1, description="procedural, or a folder of images to choose from."
    )
    lamp: tuple[float, float, float] = Field(
        (-0.45, -0.6, -0.75),
        description="Direction of the lamp from the object, in the camera's axes of frame 0.",
    )
    disturbances: Disturbances = Disturbances()
    supersample: int = Field(3, ge=1, le=9, description="Rays per pixel and axis; odd: one meets the centre.")
    seed: int = Field(0, ge=0, lt=2**32, description="Seed of the random numbers.")

    @field_validator("size")
    @classmethod
    def _images_have_a_sensible_size(cls, size: tuple[int, int]) -> tuple[int, int]:
        if min(size) < 16 or max(size) > 4096:
            raise ValueError("width and height must be from 16 to 4096 pixels")
        return size

    @field_validator("supersample")
    @classmethod
    def _one_ray_meets_the_centre(cls, supersample: int) -> int:
        if supersample % 2 == 0:
            raise ValueError("it must be odd")
        return supersample

    @field_validator("lamp")
    @classmethod
    def _the_lamp_is_somewhere(cls, lamp: tuple[float, float, float]) -> tuple[float, float, float]:
        if not 0 < math.hypot(*lamp) < math.inf:
            raise ValueError("it must be three numbers, not all 0")
        return lamp

    @model_validator(mode="after")
    def _a_room_has_walls_of_its_own(self) -> SequenceSpec:
        if self.motion in OWN_BACKGROUND and self.background != PROCEDURAL_BACKGROUND:
            own = "room" if self.motion == "walk_round" else "table"
            raise ValueError(f"{self.motion} has its own {own} as background; leave background out")
        return self

    @model_validator(mode="after")
    def _blur_has_rays_to_average(self) -> SequenceSpec:
        if self.disturbances.motion_blur > 0 and self.supersample == 1:
            raise ValueError("motion_blur needs a supersample of at least 3: it averages the rays of a pixel")
        if self.disturbances.motion_blur > 0 and self.motion == "pick_up":
            raise ValueError("pick_up is rendered without motion_blur; leave it out")
        return self

    def random(self, purpose: str) -> np.random.Generator:
        """The stream of random numbers for one purpose."""
        return np.random.default_rng([self.seed, *purpose.encode()])


def check_spec(settings: Mapping[str, Any], origin: str) -> SequenceSpec:
    """The spec with these settings.

    Args:
        settings: Settings of `SequenceSpec`, as YAML or options give them.
        origin: Where they come from, as messages call it.

    Raises:
        InputError: If a setting is unknown or its value makes no sense.
    """
    try:
        return SequenceSpec.model_validate(settings)
    except ValidationError as error:
        raise InputError(f"{origin}: {describe_validation_error(error, SequenceSpec)}") from error
