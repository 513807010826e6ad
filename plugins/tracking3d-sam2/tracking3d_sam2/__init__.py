"""SAM 2 (Ravi et al. 2024) or EdgeTAM (Zhou et al. 2025) as a mask tracker of tracking3d.

Their package ``sam2`` and their weights are the user's; nothing of them is included. The package's video predictor
keeps a memory of the object, and is given one frame after the other here, so that a live source works too.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.protocol import Options
from tracking3d_sam2.streaming import StreamingPredictor

_UNSURE = 4.0
"""Mean of the absolute logits about the outline at which the score is about .75."""


class Sam2Tracker:
    """Mask tracker ``sam2``: the memory of SAM 2's video predictor, prompted with the first box or mask."""

    class Options(Options):
        """What can be set in YAML under ``tracker:`` or with ``--set tracker.<name>=...``."""

        checkpoint: str = Field(description="File with the weights, for example sam2.1_hiera_tiny.pt.")
        config: str = Field(
            "configs/sam2.1/sam2.1_hiera_t.yaml",
            description="Configuration of these weights, as the package sam2 names it.",
        )
        device: Literal["auto", "cpu", "cuda"] = Field(
            "auto", description="Device of the network; auto is CUDA if there is one."
        )
        memory: int = Field(
            32,
            ge=16,
            le=100_000,
            description="Frames that the predictor remembers, beside the prompted ones.",
        )

    def __init__(self, predictor: StreamingPredictor) -> None:
        self._predictor = predictor

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from options that tracking3d has checked against ``Options``.

        Raises:
            PluginError: The package ``sam2`` is not installed.
            InputError: The weights do not exist, or do not belong to the configuration.
        """
        chosen = cls.Options.model_validate(options.model_dump())
        if why := cls.why_unavailable():
            raise PluginError(f"The tracker sam2 cannot be used: {why}.")
        file = Path(chosen.checkpoint).expanduser()
        if not file.is_file():
            raise InputError(
                f"The weights {file} do not exist; download a checkpoint of SAM 2 or EdgeTAM, and give its path as "
                "tracker.checkpoint."
            )
        return cls(StreamingPredictor(_build(chosen.config, file, chosen.device), chosen.memory))

    @classmethod
    def why_unavailable(cls) -> str:
        """What is missing for this tracker; empty if nothing is."""
        return "" if find_spec("sam2") else "the package sam2 is not installed (pip install sam2)"

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame from a box or a mask; a given mask is the first estimate."""
        box = clip_box(prompt.box, frame.image.shape)
        if box is None:
            raise InputError(f"The box lies outside {frame.name or 'the first frame'}; give one inside it.")
        return _estimate(self._predictor.start(frame.image, box, prompt.mask))

    def step(self, frame: Frame) -> MaskEstimate:
        """Estimate the mask in the next frame."""
        if not self._predictor.is_started:
            raise PluginError("The tracker sam2 was asked for a frame before it was started with init.")
        return _estimate(self._predictor.step(frame.image))

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Remember a better mask of the last frame; later ones follow from it."""
        if mask.any() and self._predictor.is_started:
            self._predictor.correct(mask)


def _build(config: str, checkpoint: Path, device: str) -> Any:
    """The video predictor of the package ``sam2``."""
    import torch
    from sam2.build_sam import build_sam2_video_predictor

    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return build_sam2_video_predictor(config, str(checkpoint), device=device)
    except Exception as error:  # hydra, torch and the package each raise their own
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{checkpoint} cannot be used with the configuration {config} ({reason}); give weights and configuration "
            "that belong together as tracker.checkpoint and tracker.config."
        ) from error


def _estimate(logits: NDArray[np.float32]) -> MaskEstimate:
    mask = (1 / (1 + np.exp(-np.clip(logits, -60, 60)))).astype(np.float32)
    inside = logits > 0
    if not inside.any():
        return MaskEstimate(None, 0.0, "the object is not visible")
    certainty = float(np.abs(logits[inside]).mean())
    return MaskEstimate(mask, 1 - 0.5 * 2 ** (-certainty / _UNSURE))
