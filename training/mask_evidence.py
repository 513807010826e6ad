"""Fit how much each source counts in a pixel's log-odds of being the object's, on sequences with exact masks.

``python training/mask_evidence.py FOLDER ... --out DIR`` tracks every sequence (clips as ``tracking3d synth`` writes
them) causally with the masks of a tracker, asks at pixels near either outline what the sources said and whether the
object is there, fits a logistic regression without a constant, and prints what
`tracking3d.estimation.segmentation.online_features` holds: first the weights of the shapes alone, by which the
outline is guessed whose colours are compared, then all. ``--folds N`` prints before how good fits on other sequences
are.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from tracking3d import load_config
from tracking3d.errors import InputError
from tracking3d.estimation.online import masks
from tracking3d.estimation.online.masks import mask_in_window, upsampled_window
from tracking3d.estimation.segmentation import SOURCES, as_lab, online_features, pixel_features
from tracking3d_bench.benchmark.job import Job, run_job
from tracking3d_bench.benchmark.variant import Variant

PIXELS = 500
"""Of a frame, at most; each frame counts the same."""
_PENALTY = 1e-3
_LEAST_OVERLAP = 0.4  # below with both masks, a frame is of something else
_SHAPES = 8


@dataclass(frozen=True, eq=False)
class Samples:
    """Pixels near outlines.

    Attributes:
        features: ``(N, K)``.
        inside: ``(N,)`` bool, whether they are the object's.
        weight: ``(N,)``; those of a frame sum to 1.
        sequence: ``(N,)`` int, which sequence they are of.
    """

    features: NDArray[np.float64]
    inside: NDArray[np.bool_]
    weight: NDArray[np.float64]
    sequence: NDArray[np.int64]

    def of(self, chosen: NDArray[np.bool_]) -> Samples:
        """Some of them."""
        return Samples(self.features[chosen], self.inside[chosen], self.weight[chosen], self.sequence[chosen])


def fitted(samples: Samples, columns: int | None = None) -> NDArray[np.float64]:
    """``(K,)`` weights of the first ``columns`` features."""
    X, sign = samples.features[:, :columns], 2.0 * samples.inside - 1
    share = samples.weight / samples.weight.sum()

    def loss(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        odds = sign * (X @ weights)
        slope = -(share * sign / (1 + np.exp(odds))) @ X
        return share @ np.logaddexp(0, -odds) + _PENALTY * weights @ weights, slope + 2 * _PENALTY * weights

    return np.asarray(minimize(loss, np.zeros(X.shape[1]), jac=True, method="L-BFGS-B").x)


def right_share(samples: Samples, weights: NDArray[np.float64]) -> float:
    """Share of the pixels, by weight, that weights put on the right side."""
    right = (samples.features[:, : len(weights)] @ weights > 0) == samples.inside
    return float(samples.weight @ right / samples.weight.sum())


def sampled(found: NDArray[np.float32], seed: int) -> NDArray[np.intp]:
    """Which pixels of a frame are asked: near one outline at least, and not deep within both masks."""
    near = found[..., [0, 2]]
    band = np.flatnonzero((near.max(-1) > -near.max()) & (near.min(-1) < near.max()))
    return np.random.default_rng(seed).permutation(band)[:PIXELS]


@contextmanager
def told(truth: Any, sequence: int, into: list[Samples]) -> Iterator[None]:
    """While a sequence is tracked, note what the sources say in each frame."""
    original = masks.fuse_mask

    def noting(rendered, initial, observation, confidence, colours, moving=None):
        exact = truth.masks[observation.index].read() if observation.index in truth.masks else None
        asked = exact is not None and initial is not None and exact.any()
        if asked and max(_overlap(initial, exact), _overlap(rendered, exact)) >= _LEAST_OVERLAP:
            window, image, _ = upsampled_window(observation)
            masks = [mask_in_window(mask, window) for mask in (initial, rendered, exact)]
            found = pixel_features(as_lab(image), *masks[:2], confidence, colours)
            chosen = sampled(found, observation.index)
            rows = found.reshape(-1, found.shape[-1])[chosen].astype(np.float64)
            count = len(chosen)
            weight, number = np.full(count, 1 / max(count, 1)), np.full(count, sequence)
            into.append(Samples(rows, masks[2].ravel()[chosen], weight, number))
        return original(rendered, initial, observation, confidence, colours, moving)

    masks.fuse_mask = noting
    try:
        yield
    finally:
        masks.fuse_mask = original


def collected(folders: list[Path], out: Path, tracker: str) -> Samples:
    """What the sources say in all sequences of some folders."""
    config = load_config(overrides=[f"tracker.name={tracker}", "solver.final_refine=false"])
    into: list[Samples] = []
    sequences = [
        clip for folder in folders for clip in sorted(folder.iterdir()) if (clip / "frames").is_dir()
    ]
    for number, clip in enumerate(sequences):
        job = Job("clip", clip.parent, clip.name, Variant(label=tracker, config=config), out)
        job.write()
        with told(job.truth, number, into):
            run_job(job)
        print(f"{clip.name}: {sum(len(one.inside) for one in into)} pixels", file=sys.stderr)
    if not into:
        raise InputError("There is no sequence with masks in these folders; give others.")
    parts = (
        np.concatenate([getattr(one, name) for one in into])
        for name in ("features", "inside", "weight", "sequence")
    )
    return Samples(*parts)


def main(words: list[str]) -> None:
    """Track, fit, test and print."""
    options = _options(words)
    samples = collected(options.folders, options.out, options.tracker)
    for fold in range(options.folds):
        held = samples.sequence % options.folds == fold
        if held.any() and not held.all():
            weights = fitted(samples.of(~held))
            print(f"fold {fold}: {right_share(samples.of(held), weights):.3f} of other sequences' pixels")
    print(f"as it is: {right_share(samples, np.array(list(SOURCES.values()))):.3f}")
    shapes, everything = fitted(samples, _SHAPES), fitted(samples)
    print("_BY_SHAPE =", [round(float(one), 3) for one in shapes], "was", online_features._BY_SHAPE.tolist())
    for name, weight in zip(SOURCES, everything, strict=True):
        print(f'    "{name}": {weight:.3f},')


def _overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def _options(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+", help="folders of sequences")
    parser.add_argument("--out", type=Path, required=True, help="where the runs are kept")
    parser.add_argument("--tracker", default="csrt", help="whose masks")
    parser.add_argument("--folds", type=int, default=4, help="of the sequences, to test on")
    return parser.parse_args(words)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
