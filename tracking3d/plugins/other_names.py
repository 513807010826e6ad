"""Advice for names of well-known trackers and features that no installed plug-in has."""

from __future__ import annotations

import re

from tracking3d.plugins.registration import FEATURES, TRACKERS

_SAM = (
    "MobileSAM is the plug-in tracking3d-sam (--tracker sam), or --tracker onnx with tracker.segmenter=mobile-sam, "
    "and masks of other programs are read with --masks"
)
_SAM2 = (
    "SAM 2 and EdgeTAM are the plug-in tracking3d-sam2 (--tracker sam2), which needs their package and weights, "
    "and masks of other programs are read with --masks"
)
_MASKS = "masks of other programs are read with --masks"
_U2NET = "that network runs in --tracker onnx with tracker.segmenter=u2netp"
_NETWORK = "that network runs in --features onnx with features.model=FILE.onnx"

_ADVICE: dict[str, dict[str, str]] = {
    TRACKERS: {
        **dict.fromkeys(("sam", "segmentanything", "mobilesam", "efficientsam", "fastsam"), _SAM),
        **dict.fromkeys(("sam2", "sam3", "edgetam"), _SAM2),
        **dict.fromkeys(("xmem", "cutie", "deva", "stm", "aot", "deaot", "stcn", "mask", "masks"), _MASKS),
        **dict.fromkeys(("u2net", "u2netp", "rembg"), _U2NET),
        **{name: f"it is the plug-in tracking3d-{name}" for name in ("d3s", "kcf", "nanotrack", "ostrack")},
        **dict.fromkeys(("csrdcf", "dcf"), "did you mean 'csrt'?"),
        **dict.fromkeys(("klt", "opticalflow", "lucaskanade", "raft"), "did you mean 'flow'?"),
        **dict.fromkeys(("best", "default"), "did you mean 'auto'?"),
    },
    FEATURES: {
        "aliked": "it is the plug-in tracking3d-aliked, or --features onnx with features.model=FILE.onnx",
        **dict.fromkeys(("alike", "xfeat", "superpoint"), _NETWORK),
        **dict.fromkeys(
            ("sift", "densesift", "disk", "hardnet", "hynet", "sosnet", "tfeat"),
            "kornia has it: --features kornia",
        ),
        **dict.fromkeys(("none", "color", "colour", "pixels", "image"), "did you mean 'rgb'?"),
    },
}
"""By group, and by name in small letters without hyphens and versions."""


def advice_on_name(group: str, name: str) -> str:
    """What to do instead of naming a plug-in that is not installed, as the end of a sentence; empty if unknown."""
    plain = re.sub("[^a-z0-9]", "", name.lower().partition(".")[0])
    advice = _ADVICE[group].get(plain, "")
    return advice if not advice or advice.endswith("?") else f"{advice}."
