"""Fit how much each source counts when masks are answered once more, on finished runs of sequences with exact masks.

``python training/hindsight_masks.py FOLDER --runs BENCHMARK ...`` reads the runs that ``tracking3d evaluate suite``
has left in ``BENCHMARK/runs`` (of any masks: trackers' ones say how they err, exact ones that they are to be kept),
goes over their frames as the final refinement does, asks at pixels near the outlines, and some elsewhere, what the
sources of `tracking3d.estimation.segmentation.whole_video` say and whether the object is there, fits a logistic
regression without a constant, and writes ``tracking3d/estimation/segmentation/whole_video_weights.py``. ``FOLDER``
holds the sequences. Runs with exact masks count as much as all others together.
"""

from __future__ import annotations

import argparse
import sys
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from mask_evidence import Samples, fitted, right_share
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.segmentation.temporal_neighbours import REACH
from tracking3d.estimation.segmentation.whole_video import PixelEvidence, VideoSegmenter
from tracking3d.results.files import read_mask
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.scene.view import ObjectView, crop_window

PIXELS = 400
"""Of a frame, at most; three in four of them near an outline."""
_NEAR = 0.1
_LEAST_OVERLAP = 0.4  # below with both masks, a frame is of something else
_WEIGHTS = Path(__file__).resolve().parents[1] / "tracking3d/estimation/segmentation/whole_video_weights.py"


def answered_frames(run: RunReader, clip: Path) -> Iterator[ObjectView]:
    """The frames of a finished run, with images from the ``frames`` of its sequence."""
    for record in run.frames:
        (file,) = (clip / "frames").glob(f"{record.index:06d}.*")
        image = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        answer, initial = run.mask(record.index), run.initial_mask(record.index)
        initial = np.zeros_like(answer) if initial is None else initial
        pose = np.full((4, 4), np.nan) if record.status is Status.LOST else record.T_cam_obj
        known = {"initial": initial, "confidence": record.confidence}
        yield ObjectView.of_frame(record.index, image, answer, run.camera, pose, **known)


def seen_once(run: RunReader, clip: Path) -> VideoSegmenter:
    """What all frames of a finished run say together."""
    model = load_model(run.mesh_folder)
    confidences = {one.index: one.confidence for one in run.frames if one.status is not Status.LOST}
    hindsight = VideoSegmenter(run.camera, model.vertices, model.faces, confidences)
    for frame in answered_frames(run, clip):
        hindsight.see(frame)
    hindsight.settle()
    return hindsight


def asked(
    run: RunReader, clip: Path, every: int
) -> Iterator[tuple[ObjectView, NDArray[np.bool_], PixelEvidence]]:
    """What is said of every so many frames, and where the object is in their windows ``(S, S)``."""
    hindsight = seen_once(run, clip)
    wanted = {one.index for one in run.frames[::every]}
    waiting: deque[ObjectView] = deque()

    def said(frame: ObjectView) -> Iterator[tuple[ObjectView, NDArray[np.bool_], PixelEvidence]]:
        exact = read_mask(clip / "masks" / f"{frame.index:06d}.png") if frame.index in wanted else None
        if (
            exact is None
            or max(_overlap(mask, exact) for mask in (frame.initial, frame.mask)) < _LEAST_OVERLAP
        ):
            return
        if (found := hindsight.said(frame)) is not None:
            yield frame, crop_window(exact.astype(np.float32), found[0].window) > 0.5, found[1]

    for frame in answered_frames(run, clip):
        hindsight.order.add(frame)
        waiting.append(frame)
        if len(waiting) > REACH:
            yield from said(waiting.popleft())
    for frame in waiting:
        yield from said(frame)


def collected(runs: list[tuple[Path, Path]], every: int) -> tuple[list[str], Samples, NDArray[np.bool_]]:
    """Names of the sources, what they say in all runs, and which of it is of runs with exact masks."""
    rows, inside, sequence, exact, names = [], [], [], [], list[str]()
    number_of = {clip: number for number, clip in enumerate(sorted({clip for _, clip in runs}))}
    for folder, clip in runs:
        run = RunReader(folder)
        for frame, truth, said in asked(run, clip, every):
            planes = dict(said.sources())
            names = max(names, list(planes), key=len)
            chosen = _sampled(said, frame.index)
            rows.append({name: plane.ravel()[chosen] for name, plane in planes.items()})
            inside.append(truth.ravel()[chosen])
            sequence.append(np.full(len(chosen), number_of[clip]))
            exact.append(np.full(len(chosen), run.config["tracker"]["name"] == "precomputed"))
        print(f"{folder}: {sum(map(len, inside))} pixels", file=sys.stderr, flush=True)
    if not rows:
        raise InputError(
            "There is no run of these sequences; give the folder that `evaluate suite --out` wrote."
        )
    X = np.concatenate(
        [
            np.stack([row.get(name, np.zeros(len(y))) for name in names], -1)
            for row, y in zip(rows, inside, strict=True)
        ]
    ).astype(np.float64)
    true = np.concatenate(exact)
    weight = np.concatenate([np.full(len(one), 1 / max(len(one), 1)) for one in inside])
    if true.any() and not true.all():
        weight[true] *= weight[~true].sum() / weight[true].sum()
    return names, Samples(X, np.concatenate(inside), weight, np.concatenate(sequence)), true


def main(words: list[str]) -> None:
    """Read, fit, test and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the sequences")
    parser.add_argument(
        "--runs", type=Path, nargs="+", required=True, help="folders of `evaluate suite --out`"
    )
    parser.add_argument(
        "--every", type=int, default=6, help="how many frames are passed from one to the next"
    )
    parser.add_argument("--folds", type=int, default=3, help="of the sequences, to test on")
    parser.add_argument("--samples", type=Path, help="keep what was read in this file")
    options = parser.parse_args(words)
    runs = [
        (file.parent, options.folder / file.parts[-4])
        for out in options.runs
        for file in sorted(out.glob("runs/*/*/*/run/run.json"))
        if RunReader(file.parent).state == "finished"
    ]
    names, samples, true = collected(runs, options.every)
    if options.samples:
        np.savez(options.samples, names=names, true=true, **vars(samples))
    for fold in range(options.folds):
        held = samples.sequence % options.folds == fold
        if held.any() and not held.all():
            share = right_share(samples.of(held), fitted(samples.of(~held)))
            print(f"fold {fold}: {share:.3f} of other sequences' pixels")
    weights = fitted(samples)
    lines = [f'    "{name}": {weight:.3f},' for name, weight in zip(names, weights, strict=True)]
    head = '"""The weights of the whole-video features, fitted by ``training/hindsight_masks.py``."""\n\nWEIGHTS = {\n'
    _WEIGHTS.write_text(head + "\n".join(lines) + "\n}\n", encoding="utf-8")


def _sampled(said: PixelEvidence, seed: int) -> NDArray[np.intp]:
    random = np.random.default_rng(seed)
    near = np.min([np.abs(one) for name, one in said.distances.items() if "hull" not in name], 0) < _NEAR
    band, anywhere = np.flatnonzero(near & said.in_reach), np.flatnonzero(said.in_reach)
    return np.concatenate(
        [random.permutation(band)[: 3 * PIXELS // 4], random.permutation(anywhere)[: PIXELS // 4]]
    )


def _overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        sys.exit(str(error))
