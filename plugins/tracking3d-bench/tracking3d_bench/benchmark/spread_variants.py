"""The variants of a spread: one computation under conditions that should not change it, or hardly."""

from __future__ import annotations

from enum import StrEnum

from tracking3d_bench.benchmark.input_change import InputChange
from tracking3d_bench.benchmark.processors import KERNELS, detect_kernels
from tracking3d_bench.benchmark.variant import Variant

UNCHANGED = "as it is"
RENDERERS = ("torch", "numba")
NOISE_SEEDS = (1, 2)

INPUT_CHANGES = {
    "lens given": InputChange(lens="given"),
    "lens not given": InputChange(lens="withheld"),
    "lens given 2 % too long": InputChange(lens="given", focal_scale=1.02),
    "lens given 2 % too short": InputChange(lens="given", focal_scale=0.98),
    "box moved by 2 pixels": InputChange(box_shift=(2.0, 2.0)),
    "box grown by 4 %": InputChange(box_growth=0.04),
    "first frame +1": InputChange(first_frame=1),
    "first frame +2": InputChange(first_frame=2),
    "first frame +3": InputChange(first_frame=3),
    "one grey level of noise": InputChange(grey_noise=1),
}
"""Changes of the input by label. A user could just as well have made any of them."""


class Vary(StrEnum):
    """What differs between the variants."""

    COMPUTATION = "computation"
    """The arithmetic, and one grey level of noise."""
    INPUT = "input"
    """The first box, the first frame, what is known about the lens, and one grey level of noise."""


def computation_variants(base: Variant) -> tuple[list[Variant], dict[str, str]]:
    """The variants of ``base`` that this processor can run, and why the others are left out, by label.

    Those whose kernels are the ones that the processor takes anyway are left out too: they are one computation.
    """
    variants, left_out = [base.with_changes(UNCHANGED)], {}
    seen = {detect_kernels({}): UNCHANGED}
    for label, environment in KERNELS.items():
        kernels = detect_kernels(environment)
        if kernels is None:
            left_out[label] = "this processor cannot run them"
        elif kernels in seen:
            left_out[label] = f"they are those of '{seen[kernels]}' ({kernels.openblas}, {kernels.aten})"
        else:
            seen[kernels] = label
            variants.append(base.with_changes(label).model_copy(update={"environment": environment}))
    usual = base.config.runtime.renderer
    for renderer in RENDERERS:
        if renderer != ("numba" if usual == "auto" else usual):
            variants.append(base.with_changes(f"renderer {renderer}", runtime__renderer=renderer))
    for seed in NOISE_SEEDS:
        label = f"one grey level of noise, seed {seed}"
        variants.append(base.with_changes(label).model_copy(update={"input": InputChange(grey_noise=seed)}))
    return variants, left_out


def input_variants(base: Variant) -> list[Variant]:
    """``base`` as it is, and with each of `INPUT_CHANGES`."""
    changed = [
        base.with_changes(label).model_copy(update={"input": change})
        for label, change in INPUT_CHANGES.items()
    ]
    return [base.with_changes(UNCHANGED), *changed]
