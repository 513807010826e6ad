"""What a run says of itself at its end: whose masks they are, where the time went, what was assumed or never seen."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from tracking3d.cli.summary import print_summary
from tracking3d.estimation.estimate import MaskSource, lost_estimate
from tracking3d.features.networks.catalogue import recommended_networks
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.results.contact_sheet import CROPS, TILE
from tracking3d.results.notes import describe_camera_and_model, notes_of_run, notes_of_times, unseen_share
from tracking3d.results.records import FrameRecord
from tracking3d.runtime.stage_times import STAGES, StageTimes
from tracking3d.ui.sentences import advise_networks
from tracking3d.video.image_file import read_image

pytestmark = pytest.mark.usefixtures("as_users_see_it")

TIMES = StageTimes(0.1, 0.2, 0.05, 0.3, 0.15, 0.0)


@pytest.fixture
def summary(tmp_path, turning_sphere, write_run, capsys):
    """Writes a run with the given sources of its masks; gives the printed rows and the contact sheet."""

    def write(sources, camera=turning_sphere.camera):
        estimates = [
            dataclasses.replace(
                one,
                mask_source=source,
                mask=one.initial_mask if source is MaskSource.INITIAL else one.mask,
                stages=TIMES,
                seconds=TIMES.whole,
            )
            for one, source in zip(turning_sphere.estimates, sources, strict=True)
        ]
        clip = dataclasses.replace(turning_sphere, estimates=estimates, camera=camera)
        write_run(tmp_path / "run", clip)
        print_summary(tmp_path / "run")
        lines = [line.split("│")[1:3] for line in capsys.readouterr().out.splitlines() if "│" in line]
        rows = [(name.strip(), value.strip()) for name, value in lines]
        return rows, read_image(tmp_path / "run" / "contact_sheet.png"), tmp_path / "run"

    return write


def test_answers_that_are_the_initial_masks_get_no_iou_with_them(summary):
    rows, _, run = summary([MaskSource.INITIAL] * 8)
    assert dict(rows)["frames with an estimated mask"] == "0 of 8"
    assert not any("IoU" in name for name, _ in rows)
    document = json.loads((run / "run.json").read_text())
    assert document["iou_initial_mean"] == 1 and document["iou_initial_mean_own"] is None
    assert document["counts"]["masks"] == {"rendered": 0, "fused": 0, "initial": 8, "none": 0}


def test_of_answers_that_are_its_own_the_iou_is_told_of_these(summary):
    rows, _, run = summary(
        [MaskSource.INITIAL] * 5 + [MaskSource.RENDERED, MaskSource.FUSED, MaskSource.RENDERED]
    )
    assert dict(rows)["frames with an estimated mask"] == "3 of 8; the others keep the initial mask"
    document = json.loads((run / "run.json").read_text())
    assert document["iou_initial_mean_own"] < document["iou_initial_mean"]
    assert dict(rows)["mean IoU of these with the initial masks"] == f"{document['iou_initial_mean_own']:.3f}"


def test_the_whole_time_comes_first_and_the_stages_after_it(summary):
    rows, _, _ = summary([MaskSource.RENDERED] * 8)
    names = [name for name, _ in rows]
    first = names.index("seconds per frame")
    assert tuple(names[first + 1 : first + 1 + len(STAGES)]) == STAGES
    assert float(dict(rows)["seconds per frame"]) >= 0.8
    assert dict(rows)["track"] == "0.200"


def test_the_sheet_has_a_line_for_the_time_and_none_for_no_note(summary):
    tiles = -(-min(8, CROPS) // 6) + 1
    rows, sheet, run = summary([MaskSource.RENDERED] * 8)
    assert sheet.shape[0] == tiles * TILE + 16 + 23
    assert not json.loads((run / "run.json").read_text())["notes"]
    assert "note" not in dict(rows)
    band = sheet[tiles * TILE :].astype(int)
    assert (np.abs(band - band[-1, -1]) > 60).any()  # something is written there


@pytest.mark.parametrize(
    ("tracker", "advised"), [("csrt", True), ("flow", True), ("onnx", False), ("", False)]
)
def test_a_run_without_networks_says_what_they_would_bring(tmp_path, monkeypatch, tracker, advised):
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path))
    assert advise_networks(tracker).startswith("`tracking3d models get recommended` (7 MB)") is advised


def test_nothing_is_advised_if_the_networks_are_there(tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKING3D_CACHE", str(tmp_path))
    (tmp_path / "models").mkdir()
    for network in recommended_networks():
        (tmp_path / "models" / network.file).write_bytes(b"")
    assert advise_networks("csrt") == ""


def test_an_assumed_lens_is_noted(summary, turning_sphere):
    rows, sheet, run = summary(
        [MaskSource.RENDERED] * 8, dataclasses.replace(turning_sphere.camera, assumed=True)
    )
    assert "no focal length was given: default field of view; give --fov" in dict(rows)["note"]
    assert len(json.loads((run / "run.json").read_text())["notes"]) == 1
    assert sheet.shape[0] % TILE == 16 + 2 * 23


SOLVED = {"assumed": True, "origin": "solved field of view of 17.8 degrees"}


def test_an_estimated_lens_is_a_doubt_if_its_uncertainty_says_so():
    assert describe_camera_and_model(SOLVED | {"focal_deviation": 0.08}, None) == [
        "no focal length was given: solved field of view of 17.8 degrees, uncertain by 8 % of the focal length; "
        "give --fov or --intrinsics if depth matters"
    ]
    assert describe_camera_and_model(SOLVED | {"focal_deviation": 0.01}, None) == []


def test_a_lens_that_the_video_does_not_tell_is_not_known():
    assumed = {"assumed": True, "origin": "default field of view", "focal_deviation": 0.21}
    [note] = describe_camera_and_model(assumed, None)
    assert note.startswith(
        "no focal length was given: default field of view, and the video does not tell it; give"
    )


@pytest.mark.parametrize("unknown", [{}, {"focal_deviation": None}], ids=["earlier version", "not estimated"])
def test_a_lens_of_which_nothing_says_how_certain_it_is_is_a_doubt(unknown):
    [note] = describe_camera_and_model(SOLVED | unknown, None)
    assert note.startswith("no focal length was given: solved field of view of 17.8 degrees; give --fov")
    assert describe_camera_and_model(SOLVED | unknown | {"assumed": False}, None) == []


def test_a_surface_that_was_mostly_never_seen_is_noted(turning_sphere):
    # The texture's weight is 0 below v = 0.8: on a sphere of height 2 that is about a tenth of its surface.
    assert unseen_share(turning_sphere.model) == pytest.approx((1 - np.cos(0.2 * np.pi)) / 2, abs=0.02)
    weight = turning_sphere.model.texture_weight.copy()
    weight[: len(weight) // 2 + 8] = 0  # the upper half and some
    mostly = dataclasses.replace(turning_sphere.model, texture_weight=weight)
    share = unseen_share(mostly)
    assert 0.6 < share < 0.85
    assert describe_camera_and_model({"assumed": False, "origin": ""}, mostly) == [
        f"{100 * share:.0f} % of the mesh's surface was never seen and is a guess; film its other sides in a second "
        "video, and add them by --object RUN --extend"
    ]


def timed(*milliseconds: int) -> list[FrameRecord]:
    image = np.zeros((4, 4, 3), np.uint8)
    frames = [Frame(2 * n, image, time / 1000) for n, time in enumerate(milliseconds)]
    return [FrameRecord.of(lost_estimate(frame, MaskEstimate(None), np.eye(4))) for frame in frames]


@pytest.mark.parametrize("times", [(), (0,), (0, 40), (0, 40, 80, 120), (0, 33, 67, 100), (0, 0, 40)])
def test_frames_that_come_evenly_need_no_note(times):
    assert notes_of_times(timed(*times)) == []


def test_a_variable_frame_rate_is_a_note_but_not_of_a_camera():
    records = timed(0, 40, 80, 200)  # every second frame
    [note] = notes_of_times(records)
    assert note.startswith("frame intervals vary from 20 to 60 ms (variable frame rate)")
    run = {"source_notes": ["toned"], "camera": {"assumed": False, "origin": ""}, "prompt": {"frames": 4}}
    assert notes_of_run(run, None, records) == ["toned", note]
    assert notes_of_run(run | {"prompt": {"frames": None}}, None, records) == ["toned"]
