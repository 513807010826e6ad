"""``tracking3d bench masks``: what it prints, and what it refuses."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize, write_clip

TRACKER = '''
from typing import Self

import numpy as np

from tracking3d.frames import MaskEstimate
from tracking3d.trackers.protocol import Options


class Still:
    """Answers with the first mask or box; fails in frames that are wide enough."""

    class Options(Options):
        fail: int = 10**6

    def __init__(self, options):
        self.options = options

    @classmethod
    def from_options(cls, options) -> Self:
        return cls(options)

    def init(self, frame, prompt):
        if frame.size[1] >= self.options.fail:
            raise RuntimeError("too wide")
        x, y, width, height = (round(side) for side in prompt.box)
        self.mask = np.zeros(frame.size, np.float32)
        self.mask[y : y + height, x : x + width] = 1
        if prompt.mask is not None:
            self.mask = prompt.mask.astype(np.float32)
        return MaskEstimate(self.mask)

    def step(self, frame):
        return MaskEstimate(self.mask)
'''


@pytest.fixture(scope="module")
def two_clips():
    """By name."""
    widths = {"narrow": 64, "wide": 72}
    return {
        name: synthesize(SyntheticSpec(frames=3, size=(w, 48), supersample=1)) for name, w in widths.items()
    }


@pytest.fixture
def bench(call, two_clips, tmp_path, monkeypatch):
    """Call the command on two small clips with a tracker that stands still, or with flow."""
    for name, clip in two_clips.items():
        poses, camera = clip.T_cam_obj, clip.camera
        write_clip(tmp_path / "clips" / name, clip.images, clip.masks, poses, camera, source="test", note="")
    file = tmp_path / "still_tracker.py"
    file.write_text(TRACKER)
    plugins = f"{file}:Still", "tracking3d.trackers.flow:FlowTracker"
    items = (f"tracking3d.trackers:{n}={value}" for n, value in zip(("still", "flow"), plugins, strict=True))
    monkeypatch.setenv("TRACKING3D_PLUGINS", ";".join(items))

    def bench(*arguments: object):
        return call("bench", "masks", "real", "--data", tmp_path / "clips", *arguments)

    return bench


def test_trackers_are_measured_and_printed(bench):
    result = bench("--tracker", "still", "--tracker", "flow")
    assert result.exit_code == 0, result.output
    assert [line for line in result.stdout.splitlines() if "mean" in line and "still" in line]
    assert "narrow (flow): IoU" in result.stderr


def test_json_holds_every_frame(bench):
    result = bench("--tracker", "still", "--json", "--sequence", "wide", "--frames", 2)
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    [one] = document["results"]
    assert (one["sequence"], one["frames_scored"], document["start"]) == ("wide", 1, "box")
    assert one["frames"][0]["iou"] == pytest.approx(document["mean"]["still"]["iou_mean"])


def test_trackers_start_from_the_true_mask_where_that_is_asked_for(bench):
    """The tracker repeats what it is given, and the objects turn: other answers, IoUs that differ."""
    ious = [
        json.loads(bench("--tracker", "still", "--json", "--start", start).stdout)["mean"]["still"][
            "iou_mean"
        ]
        for start in ("box", "mask")
    ]
    assert ious[0] != pytest.approx(ious[1], abs=1e-3)


def test_a_failure_is_a_row_and_an_exit_code(bench):
    result = bench("--tracker", "still", "--set", "tracker.fail=70")
    assert result.exit_code == 1
    assert "too wide" in result.stdout and "narrow" in result.stdout
    quiet = bench("--tracker", "still", "--set", "tracker.fail=70", "--json")
    assert quiet.exit_code == 1 and "too wide" in quiet.stderr
    errors = {one["sequence"]: bool(one["error"]) for one in json.loads(quiet.stdout)["results"]}
    assert errors == {"narrow": False, "wide": True}


def test_an_ablation_has_a_row_for_every_cue(bench):
    result = bench("--tracker", "flow", "--ablation", "--json", "--sequence", "narrow", "--frames", 2)
    assert result.exit_code == 0, result.output
    labels = list(json.loads(result.stdout)["mean"])
    assert labels[0] == "flow" and "flow, no motion" in labels and len(labels) == 10
    assert np.isfinite([one["iou_mean"] for one in json.loads(result.stdout)["results"]]).all()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--tracker", "nothing"), "no mask tracker 'nothing'"),
        (("--tracker", "still", "--set", "tracker.fial=1"), "fail"),
        (("--tracker", "still", "--ablation"), "no cues"),
        (("--tracker", "still", "--sequence", "three"), "no sequence 'three'"),
    ],
)
def test_what_cannot_be_meant_is_refused(bench, arguments, words):
    result = bench(*arguments)
    assert result.exit_code == 2 and words in result.stderr and len(result.stderr.splitlines()) == 1
