"""The mask tracker ``auto``: the best of those at hand whose cost, as it was measured once, the video can afford.

Nothing is timed where it runs: the same video and the same networks give the same tracker, whatever the load.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from tracking3d.config.models import AUTO, PipelineConfig, PluginChoice
from tracking3d.features.networks.catalogue import known_networks
from tracking3d.features.networks.store import State, state_of
from tracking3d.plugins import TRACKERS, check_options

AFFORDABLE = 900.0
"""Seconds that the masks of a whole video may take (chosen)."""
UNHURRIED, LIVE = 1.0, 0.1
"""Seconds that one frame's mask may take if the number of frames is unknown, or of a camera (chosen)."""
SECONDS_PER_MEGAPIXEL = 0.05
"""Growth of any tracker's cost with the picture: .059 with csrt, .048 with segment, .037 with flow (measured).

Networks see a crop of a fixed size, so that only their box tracker and colours cost more.
"""
_USUAL = 0.3072  # megapixels, 640 x 480


@dataclass(frozen=True)
class TrackerCandidate:
    """A mask tracker that was measured."""

    name: str  # name of the plug-in
    what: str  # what sentences call it
    iou: float  # mean IoU with true masks over the four real clips, see docs/masks.md
    seconds: float  # processor time of a frame of 640 x 480 pixels, from the same page
    networks: tuple[str, ...] = ()  # known networks that it needs
    options: dict[str, Any] = field(default_factory=dict)  # its options

    def cost(self, size: tuple[int, int]) -> float:
        """Seconds of a frame of ``(height, width)`` pixels."""
        return self.seconds + SECONDS_PER_MEGAPIXEL * max(size[0] * size[1] / 1e6 - _USUAL, 0.0)


_SAM = {"segmenter": "mobile-sam", "encoder": "mobile-sam-encoder", "decoder": "mobile-sam-decoder"}
_U2 = {"segmenter": "u2netp", "model": "u2netp"}
_NANO = {"box": "nano", "nano_backbone": "nanotrack-backbone", "nano_head": "nanotrack-head"}
_NANO3 = {"box": "nano", "nano_backbone": "nanotrack3-backbone", "nano_head": "nanotrack3-head"}
_SAM_FILES, _U2_FILES = ("mobile-sam-encoder", "mobile-sam-decoder"), ("u2netp",)
_NANO_FILES = ("nanotrack-backbone", "nanotrack-head")
_NANO3_FILES = ("nanotrack3-backbone", "nanotrack3-head")

CANDIDATES = (
    TrackerCandidate("onnx", "MobileSAM in NanoTrack's box", 0.940, 1.57, _SAM_FILES + _NANO_FILES, _SAM | _NANO),
    TrackerCandidate(
        "onnx", "U2Netp in NanoTrack 3's box", 0.930, 0.94, _U2_FILES + _NANO3_FILES, _U2 | _NANO3
    ),
    TrackerCandidate("onnx", "MobileSAM in CSR-DCF's box", 0.919, 1.60, _SAM_FILES, _SAM),
    TrackerCandidate("onnx", "U2Netp in NanoTrack's box", 0.918, 0.97, _U2_FILES + _NANO_FILES, _U2 | _NANO),
    TrackerCandidate(
        "onnx", "MobileSAM in NanoTrack's box, every 5th frame", 0.912, 0.36, _SAM_FILES + _NANO_FILES,
        _SAM | _NANO | {"every": 5},
    ),
    TrackerCandidate(
        "onnx", "U2Netp in NanoTrack 3's box, every 5th frame", 0.904, 0.24, _U2_FILES + _NANO3_FILES,
        _U2 | _NANO3 | {"every": 5},
    ),
    TrackerCandidate("segment", "segment, whose network comes with the package", 0.904, 0.05),
    TrackerCandidate(
        "onnx", "U2Netp in NanoTrack's box, every 5th frame", 0.894, 0.25, _U2_FILES + _NANO_FILES,
        _U2 | _NANO | {"every": 5},
    ),
    TrackerCandidate("onnx", "U2Netp in CSR-DCF's box", 0.888, 1.00, _U2_FILES, _U2),
    # Estimates to the masks of both, which correct them, have a mean IoU of .880 with csrt and .883 with flow on 24
    # fresh clips, and of .891 and .874 on five real ones; flow takes half of the time.
    TrackerCandidate("csrt", "csrt, which needs no network", 0.857, 0.06),
    TrackerCandidate("flow", "flow, which needs neither network nor correlation filter", 0.789, 0.03),
)  # fmt: skip
"""The best first."""


def check_tracker_options(config: PipelineConfig) -> None:
    """Make sure of the options of the mask tracker; ``auto`` has none.

    Raises:
        PluginError: If the tracker is unknown or broken, or an option is wrong.
    """
    if config.tracker.name != AUTO:
        check_options(TRACKERS, config.tracker)


def choose_tracker(
    config: PipelineConfig, frames: int | None, live: bool, size: tuple[int, int]
) -> tuple[PipelineConfig, str | None]:
    """The configuration with a tracker in place of ``auto``, and why it is that one; nothing is fetched.

    Args:
        config: The pipeline; with another tracker than ``auto`` it is given back, and no reason.
        frames: Number of frames, if it is known.
        live: Whether they do not wait.
        size: Height and width of the frames in pixels.
    """
    if config.tracker.name != AUTO:
        return config, None
    budget = LIVE if live else UNHURRIED if not frames else AFFORDABLE / frames
    passed = ""
    for candidate in _usable_candidates():
        cost = candidate.cost(size)
        if cost <= budget or not candidate.networks:
            choice = PluginChoice(name=candidate.name, **candidate.options)
            why = f"{candidate.what}: mean IoU {candidate.iou:.2f} on the measured clips, about {cost:.2f} s a frame"
            if passed:
                why += f"; within {budget:.2g} s a frame, which rules out {passed}"
            elif not candidate.networks:
                why += "; no network of a better one is in your cache (`tracking3d models list`)"
            return config.model_copy(update={"tracker": choice}), f"{choice.name} ({why})"
        passed = passed or candidate.what
    raise AssertionError("the last candidate needs nothing and is always taken")


def _usable_candidates() -> Iterator[TrackerCandidate]:
    """The candidates whose networks are in the cache, whole; ``segment`` and ``csrt`` if this OpenCV allows them."""
    from tracking3d.trackers.csrt import CsrtTracker
    from tracking3d.trackers.segment.tracker import SegmentTracker

    known = known_networks()
    whole: dict[str, bool] = {}
    for candidate in CANDIDATES:
        if candidate.name == "csrt" and CsrtTracker.why_unavailable():
            continue
        if candidate.name == "segment" and SegmentTracker.why_unavailable():
            continue
        for name in candidate.networks:
            if name not in whole:
                whole[name] = state_of(known[name]) in (State.OK, State.UNCHECKED)
        if all(whole[name] for name in candidate.networks):
            yield candidate
