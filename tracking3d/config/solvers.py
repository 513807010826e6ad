"""The settings of each solver, and the choice between them by ``solver.name``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from tracking3d.config.section import Section

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


class OnlineConfig(Section):
    """The solver ``online``: tracked points combined with re-rendering."""

    name: Literal["online"] = Field("online", description="Name of the solver: paper or online.")
    final_refine: FinalRefine = True
    correct_tracker: CorrectTracker = True
    appearance: float = Field(1.0, ge=0, description="Weight of the photometric loss in the pose of a frame.")
    outline: float = Field(
        0.3, ge=0, description="Weight of the distance between the outline and the mask, robust."
    )
    points: float = Field(
        1.0, ge=0, description="Weight of the reprojection errors of tracked points, robust."
    )
    keyframe_rotation: float = Field(
        8.0,
        gt=0,
        description="A frame becomes a keyframe if it is rotated by more than this many degrees from all keyframes.",
    )
    window: int = Field(
        12,
        ge=2,
        le=64,
        description="Keyframes in local mapping: half of them recent, half spread over the older ones.",
    )
    most_keyframes: int = Field(
        64,
        ge=8,
        le=512,
        description="Maximum number of keyframes; the one nearest to another view is culled first.",
    )
    smoothness: float = Field(300.0, gt=0, description="Weight of the Laplacian smoothness of the shape.")
    surface_prior: float = Field(
        20.0, ge=0, description="Weight that pulls points to the surface, per squared object unit."
    )


class Weights(Section):
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
    correct_tracker: CorrectTracker = False
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
    band: Literal["erode", "soften", "none"] = Field(
        "erode",
        description=(
            "How the bias of the soft silhouette is removed: erode the silhouette by 3x3, soften the target with the "
            "same kernel, or not at all."
        ),
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
    agreement: float = Field(
        0.0,
        ge=0,
        le=1,
        description=(
            "Return the initial mask if its IoU with the rendered mask is below this; 0 always returns the rendered "
            "mask (paper)."
        ),
    )
    stop: Literal["threshold", "plateau"] = Field(
        "threshold",
        description=(
            "Stop a frame as soon as the appearance loss is below tau (paper), or as soon as the total loss is below "
            "its initial value and no longer falls. The best state is kept."
        ),
    )
    patience: int = Field(
        10, ge=1, description="With plateau: iterations without progress before a frame stops."
    )
    prediction: Literal["last", "velocity"] = Field(
        "last",
        description=(
            "Motion model: a frame starts from the last pose (paper), or from the best of last pose, constant velocity "
            "and the shift of the mask."
        ),
    )
    pose_iterations: int = Field(
        0,
        ge=0,
        description="Iterations on the pose of the new frame alone, before the joint ones; 0 for none (paper).",
    )
    joint: Literal["always", "new_view"] = Field(
        "always",
        description=(
            "Optimize shape, texture and all poses in every frame (paper), or only in frames that show a new view or "
            "that their pose alone does not explain; needs pose_iterations."
        ),
    )
    texture_start: Literal["zero", "backprojected"] = Field(
        "zero",
        description="Texels not seen before start at zero (paper), or at the features that the new frame shows there.",
    )
    unseen_charge: float | None = Field(
        None,
        ge=0,
        description=(
            "Loss of a pixel whose texture has never been seen, in place of its appearance loss; null treats it like "
            "any other pixel (paper)."
        ),
    )
    start_frames: int = Field(
        1,
        ge=1,
        le=32,
        description=(
            "Number of first frames that are solved together from several rotation hypotheses; 1 switches this off "
            "(paper)."
        ),
    )
    start_iterations: int = Field(
        60, ge=1, description="Iterations of each hypothesis in that initialization."
    )
    weights: Weights = Weights()
    learning_rates: LearningRates = LearningRates()
    keyframes: KeyframeConfig = KeyframeConfig()


def _written_out(value: Any) -> Any:
    """``paper`` is short for ``{name: paper}``, and settings without a name are those of the default solver.

    A section with all lines commented out changes nothing.
    """
    if isinstance(value, str):
        return {"name": value}
    if not isinstance(value, Mapping):
        return value
    empty = {key for key in ("weights", "learning_rates", "keyframes") if value.get(key, key) is None}
    return {"name": OnlineConfig().name, **{key: value[key] for key in value if key not in empty}}


SolverConfig = Annotated[
    OnlineConfig | PaperConfig, Field(discriminator="name"), BeforeValidator(_written_out)
]
"""The solver that ``name`` chooses, with its own settings only."""
