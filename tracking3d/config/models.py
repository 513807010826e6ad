"""The settings as pydantic models: every key with its default, range and meaning.

The defaults are those of preset ``default``; ``tracking3d/config/presets`` holds what other presets change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator


class Section(BaseModel):
    """Base of all sections: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


FinalRefine = Annotated[
    bool,
    Field(
        description=(
            "After the last frame, re-estimate every frame with the final model; causal estimates are kept too. Not "
            "for live sources, nor for every solver."
        )
    ),
]
CorrectTracker = Annotated[
    bool, Field(description="Re-anchor the mask tracker on the estimated mask if that is confident.")
]


class TrackingWeights(Section):
    """Weights of the robust losses of a frame's pose in the solver ``online``."""

    appearance: float = Field(1.0, ge=0, description="Appearance: differences of features, pixel by pixel.")
    outline: float = Field(0.3, ge=0, description="Outline: distances from the mask's outline.")
    points: float = Field(1.0, ge=0, description="Points: reprojection errors of the tracked points.")


class OnlineConfig(Section):
    """The solver ``online``: tracked points combined with re-rendering."""

    name: Literal["online"] = Field("online", description="Name of the solver: paper or online.")
    final_refine: FinalRefine = True
    tracker_feedback: CorrectTracker = True
    weights: TrackingWeights = TrackingWeights()
    keyframe_rotation: float = Field(
        8.0,
        gt=0,
        description="A frame becomes a keyframe if it is rotated by more than this many degrees from all keyframes.",
    )
    local_window: int = Field(
        12,
        ge=2,
        le=64,
        description="Keyframes in local mapping: half of them recent, half spread over the older ones.",
    )
    max_keyframes: int = Field(
        64,
        ge=8,
        le=512,
        description="Maximum number of keyframes; the one nearest to another view is culled first.",
    )
    smoothness: float = Field(300.0, gt=0, description="Weight of the Laplacian smoothness of the shape.")
    # measured: at 20 sides of cube_in_hand that turn into view are bent to a surface that is a guess there
    surface_prior: float = Field(
        3.0, ge=0, description="Weight that pulls points to the surface, per squared object unit."
    )


class LossWeights(Section):
    """Weights of the loss terms; 0 switches a term off (paper section 3.3)."""

    features: float = Field(1.0, ge=0, description="Appearance loss, eq. 1.")
    silhouette: float = Field(1.0, ge=0, description="Silhouette loss, IoU term of eq. 2.")
    distance: float = Field(
        1.0, ge=0, description="Silhouette loss, distance-transform term of eq. 2, times `silhouette`."
    )
    motion: float = Field(1.0, ge=0, description="Motion regularization, eq. 3.")
    laplacian: float = Field(1000.0, ge=0, description="Laplacian shape regularization.")
    total_variation: float = Field(0.001, ge=0, description="Total variation of the texture.")


class LearningRates(Section):
    """Adam's learning rate for each group of parameters (paper: 0.1 for all)."""

    translation: float = Field(0.1, ge=0)
    rotation: float = Field(0.1, ge=0)
    vertices: float = Field(0.1, ge=0)
    texture: float = Field(0.1, ge=0)


class KeyframeConfig(Section):
    """Which frames stay in the optimization (paper section 3.4)."""

    maximum: int = Field(6, ge=1, le=64, description="Number of most recent keyframes that are kept.")
    silhouette: float = Field(0.3, gt=0, description="The silhouette loss of a keyframe must be below this.")
    features: float | None = Field(
        None,
        gt=0,
        description="The appearance loss of a keyframe must be below this; null takes the encoder's tau.",
    )
    translation: float = Field(
        0.5, ge=0, description="A new view has moved by more than this times the size of the object, or ..."
    )
    rotation: float = Field(
        45.0, ge=0, description="... rotated by more than this many degrees since the latest keyframe."
    )
    keep_first: bool = Field(False, description="Frame 0 always stays a keyframe.")


class PaperConfig(Section):
    """The solver ``paper``. Defaults are the published recipe."""

    name: Literal["paper"] = Field("paper", description="Name of the solver: paper or online.")
    final_refine: FinalRefine = False
    tracker_feedback: CorrectTracker = False
    iterations: int = Field(500, ge=1, le=100_000, description="Maximum number of iterations per frame.")
    tau: float | None = Field(
        None,
        gt=0,
        description="A frame has converged if its appearance loss is below this; null takes the encoder's own value.",
    )
    cauchy_scale: float = Field(0.25, gt=0, description="Scale of the Cauchy loss.")
    sigma: float = Field(7000.0, gt=0, description="Sharpness of the soft silhouette, per squared NDC unit.")
    boxlen: float = Field(
        0.02, gt=0, lt=1, description="Extent of the soft silhouette beyond the box of a face, in NDC."
    )
    knum: int = Field(30, ge=1, description="Maximum number of faces per pixel of the soft silhouette.")
    silhouette_bias: Literal["erode", "soften", "none"] = Field(
        "erode",
        description="How the bias of the soft silhouette is removed: erode the silhouette by 3x3, soften the target "
        "with the same kernel, or not at all.",
    )
    motion_translation: float = Field(
        0.1, ge=0, description="Translation per frame since the last keyframe that is not penalized, eq. 3."
    )
    motion_rotation: float = Field(
        30.0,
        ge=0,
        description="Rotation in degrees per frame since the last keyframe that is not penalized, eq. 3.",
    )
    laplacian_of: Literal["vertices", "offsets"] = Field(
        "vertices",
        description="Smooth the vertices themselves (SoftRas), or their offsets from the prototype.",
    )
    min_mask_iou: float = Field(
        0.0,
        ge=0,
        le=1,
        description="Return the initial mask if its IoU with the rendered mask is below this; 0 always returns the "
        "rendered mask (paper).",
    )
    stop: Literal["threshold", "plateau"] = Field(
        "threshold",
        description="Stop a frame as soon as the appearance loss is below tau (paper), or as soon as the total loss is "
        "below its initial value and no longer falls. The best state is kept.",
    )
    patience: int = Field(
        10, ge=1, description="With plateau: iterations without progress before a frame stops."
    )
    prediction: Literal["last", "velocity"] = Field(
        "last",
        description="Motion model: a frame starts from the last pose (paper), or from the best of last pose, constant "
        "velocity and the shift of the mask.",
    )
    pose_iterations: int = Field(
        0,
        ge=0,
        description="Iterations on the pose of the new frame alone, before the joint ones; 0 for none (paper).",
    )
    joint_when: Literal["always", "new_view"] = Field(
        "always",
        description="Optimize shape, texture and all poses in every frame (paper), or only in frames that show a new "
        "view or that their pose alone does not explain; needs pose_iterations.",
    )
    texture_init: Literal["zero", "backprojected"] = Field(
        "zero",
        description="Texels not seen before start at zero (paper), or at the features that the new frame shows there.",
    )
    unseen_penalty: float | None = Field(
        None,
        ge=0,
        description="Loss of a pixel whose texture has never been seen, in place of its appearance loss; null treats "
        "it like any other pixel (paper).",
    )
    init_frames: int = Field(
        1,
        ge=1,
        le=32,
        description="Number of first frames that are solved together from several rotation hypotheses; 1 switches this "
        "off (paper).",
    )
    init_iterations: int = Field(
        60, ge=1, description="Iterations of each hypothesis in that initialization."
    )
    weights: LossWeights = LossWeights()
    learning_rates: LearningRates = LearningRates()
    keyframes: KeyframeConfig = KeyframeConfig()


def _expand(value: Any) -> Any:
    """``paper`` is short for ``{name: paper}``, and settings without a name are those of the default solver.

    A section with all lines commented out changes nothing.
    """
    if isinstance(value, str):
        return {"name": value}
    if not isinstance(value, Mapping):
        return value
    empty = {key for key in ("weights", "learning_rates", "keyframes") if value.get(key, key) is None}
    return {"name": OnlineConfig().name, **{key: value[key] for key in value if key not in empty}}


SolverConfig = Annotated[OnlineConfig | PaperConfig, Field(discriminator="name"), BeforeValidator(_expand)]
"""The solver that ``name`` chooses, with its own settings only."""


LARGEST_OBJECT = 1e6
"""Metres that an object's longest side may have; chosen."""
RETRACK_ANGLE = 0.75
"""Degrees; measured on box_in_hand and cube_in_hand."""
MASK_INTERVAL = 2
"""Frames; measured on box_in_hand and cube_in_hand."""
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
        None, gt=1, lt=170, description="Vertical field of view in degrees. 45 if nothing better is known."
    )
    intrinsics: tuple[float, float, float, float] | None = Field(
        None,
        description="Focal lengths and principal point, in pixels of the full frame. As fx, fy, cx, cy; overrides fov.",
    )

    distortion: tuple[float, ...] | None = Field(
        None,
        max_length=14,
        description="Lens distortion coefficients in OpenCV's order. They are k1, k2, p1, p2, k3 and so on; images are "
        "undistorted when they are read, and masks distorted when they are written.",
    )
    distortion_model: Literal["radtan", "fisheye"] = Field(
        "radtan",
        description="Distortion model: radtan (radial-tangential, OpenCV's default) or fisheye (equidistant).",
    )
    file: str | None = Field(
        None,
        description="Camera file with intrinsics and distortion: YAML of OpenCV, ROS or Kalibr, or COLMAP's "
        "cameras.txt.",
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
        description="The folder of an earlier run or a mesh file: the object is that one, and is found in the video "
        "without an initialization by motion. Shape and colours are kept: adjustment_views and texture_views are 0, "
        "shape is fast, and prototype is ignored.",
    )
    extends: str | None = Field(
        None,
        description="The folder of an earlier run of the same object: at the end of this run the frames of both videos "
        "make its mesh, with the sides that each of them shows.",
    )
    prototype: str = Field(
        "ellipsoid",
        description="Initial shape: sphere, ellipsoid or a mesh file. The ellipsoid is fitted to the first mask.",
    )
    frequency: int = Field(11, ge=1, le=40, description="Icosphere frequency f: 10 f^2 + 2 vertices.")
    texture_size: int = Field(150, ge=16, le=2048, description="Side of the feature texture in texels.")
    texture_channels: int | None = Field(
        16,
        ge=1,
        le=512,
        description="Features with more channels are reduced to this number by a principal component analysis inside "
        "the first mask, and scaled to a common spread; null keeps them unchanged (paper).",
    )
    adjustment_views: int = Field(
        120,
        ge=0,
        le=2000,
        description="Most keyframes in the final bundle adjustment of poses, surface and, if not given, focal length. "
        "48 or a fifth of the frames are taken unless they share too few landmarks. The other frames follow them. 0 "
        "switches the adjustment off.",
    )
    retrack_angle: float = Field(
        RETRACK_ANGLE,
        ge=0,
        description="With solver.final_refine: a tracked frame keeps its causal estimate if the final bundle "
        "adjustment moves its pose by at most so many degrees against the other frames. 0 estimates every frame "
        "again.",
    )
    trust_masks: bool = Field(
        False,
        description="The masks of all frames (--masks) are right, for example drawn by hand: keep them. Poses and "
        "surface are fitted to them throughout.",
    )
    refine_masks: bool = Field(
        True,
        description="Segment every frame again at the end of the final refinement, from shape, colour and motion in "
        "all frames together. With trust_masks nothing is segmented again.",
    )
    mask_agreement: float = Field(
        MASK_AGREEMENT,
        gt=0,
        le=1,
        description="In the final refinement a mask that agrees by more than this IoU with the silhouette and the "
        "initial mask is right: it need not be segmented again, nor its frame be estimated again. 1 does both in all "
        "frames.",
    )
    mask_interval: int = Field(
        MASK_INTERVAL,
        ge=1,
        le=8,
        description="Frames from one that a mask tracker is asked about to the next, if it can leave frames out, while "
        "solver online is sure of the object and tracks points on it; in between its mask is moved as these points "
        "are. 1 asks it about every frame.",
    )
    texture_views: int = Field(
        24,
        ge=0,
        le=500,
        description="Frames that the texture of the mesh is taken from at the resolution of the video, after the final "
        "refinement; 0 keeps the solver's texture, of size texture_size.",
    )
    max_texture_size: int = Field(
        2048, ge=64, le=8192, description="Maximum side of the texture image of the mesh, in texels."
    )
    shape: Literal["auto", "fast", "fine"] = Field(
        "auto",
        description="Shape of the final mesh: fast takes that of the online map; fine reconstructs it from all frames "
        "after the final refinement, and keeps the result if it explains held-out frames better; auto does so where "
        "that is possible.",
    )
    size: float | None = Field(
        None,
        gt=0,
        le=LARGEST_OBJECT,
        description="Metres of the object's longest side; all lengths of the run are then in metres. It is that of the "
        "smallest box around what the video has shown; null leaves the run's arbitrary unit. A known object has its "
        "own unit.",
    )
    flat: bool = Field(
        False,
        description="The object is planar, like a card. All vertices are projected onto one plane at each iteration.",
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
        128,
        ge=32,
        le=1024,
        description="Working resolution: side of the square crop around the object, in pixels.",
    )
    margin: float = Field(
        0.3,
        ge=0.05,
        le=2,
        description="Margin on each side, relative to the longer side of the mask's box.",
    )


class RuntimeConfig(Section):
    """Device, threads, and what a run keeps and tolerates."""

    device: str = Field("cpu", description="Device: cpu, cuda or cuda:N.")
    seed: int = Field(0, ge=0, lt=2**64, description="Random seed of the run.")
    threads: int = Field(
        1,
        ge=1,
        description="CPU threads of torch and of the renderer. One is hardly slower than several, and far faster on a "
        "busy machine or if several runs share it. The final bundle adjustment uses as many threads as OpenCV does.",
    )
    renderer: Literal["auto", "torch", "numba"] = Field(
        "auto",
        description="Rendering backend: torch (any device), numba (CPU), or auto, the fastest available.",
    )
    rollback_points: int = Field(
        8,
        ge=0,
        le=64,
        description="Saved states of earlier frames that a correction can restart from, also after the run has "
        "finished; 0 for none.",
    )
    probabilities: bool = Field(
        False, description="Write the object probability of every pixel too, as 8-bit PNG."
    )
    on_plugin_failure: Literal["continue", "stop"] = Field(
        "continue",
        description="If a plug-in fails after the first frame: continue with the last mask, or stop. The reason is "
        "recorded, and finished frames are kept.",
    )


def _one_or_several(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


Texts = Annotated[tuple[str, ...], BeforeValidator(_one_or_several)]
"""One text or a list of them."""


class PromptSection(Section):
    """The objects to track; every value is written as on the command line. Only ``run`` reads it, for one video."""

    box: Texts = Field(
        (),
        description="Box around the object in the first frame, in pixels, or a file in VOT's region format; several "
        "boxes are several objects.",
    )
    box_format: Literal["xywh", "xyxy"] | None = Field(
        None, description="How boxes are written: X,Y,WIDTH,HEIGHT, the default, or X1,Y1,X2,Y2."
    )
    mask: Texts = Field(
        (),
        description="Mask image of the object in the first frame; @N picks object N of an indexed image, and several "
        "masks are several objects.",
    )
    points: Texts = Field(
        (),
        description="Points in the first frame, + on the object and - on the background; several are several objects.",
    )
    start_frame: int | None = Field(
        None,
        ge=0,
        description="Frame of the prompt, if not the first; tracking runs forwards and backwards from it.",
    )
    correct: Texts = Field(
        (), description="Prompt in a later frame, or several; the mask tracker restarts from it."
    )


class PipelineConfig(Section):
    """The whole pipeline."""

    tracker: PluginChoice = Field(
        PluginChoice(name=AUTO),
        description="Mask tracker; `tracking3d plugins` lists them, and auto takes the best one at hand.",
    )
    features: PluginChoice = Field(PluginChoice(name="rgb"), description="Feature encoder.")
    keypoints: PluginChoice = Field(PluginChoice(name="sift"), description="Keypoint detector.")
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
