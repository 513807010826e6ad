"""A plug-in that fails in the middle of a run: the frame is recorded with the reason, and the run goes on or stops."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from failing_plugins import there_and_back

from tracking3d import Session, Status, load_config, track
from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Prompt
from tracking3d.pipeline.record import record
from tracking3d.plugins import VARIABLE
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.video import open_source

FILE = Path(__file__).parent / "failing_plugins.py"
REGISTERED = f"tracking3d.trackers:bad={FILE}:FailingTracker;tracking3d.features:bad={FILE}:FailingEncoder"
QUICK = [
    "crop.size=32",
    "object.frequency=2",
    "camera.fov=45",
    "object.texture_size=16",
]
QUICK_PRESETS = {
    "default": QUICK,
    "rerendering": [
        *QUICK,
        "solver.iterations=2",
        "solver.pose_iterations=2",
        "solver.init_frames=1",
        "solver.tau=2",
    ],
}
"""A preset of either solver, each with settings that are quick."""
TRACKER_FAULTS = {
    "raises": "ZeroDivisionError: no pixels",
    "exits": "SystemExit: 3",
    "refuses": "The third mask is missing",
    "says nothing": "it returned None instead of a MaskEstimate",
    "array": "it returned a ndarray of float32 instead of a MaskEstimate",
    "shape": "its mask has shape (3, 4), but the frame has (64, 80)",
    "nan": "its mask has values from nan to nan instead of from 0 to 1",
    "range": "its mask has values from 0 to 255 instead of from 0 to 1",
    "list": "its mask is a list instead of an array of float32",
    "score": "its score is nan instead of a number from 0 to 1",
}
ENCODER_FAULTS = {
    "raises": "ZeroDivisionError: no channels",
    "array": "it returned a ndarray of float32 instead of a tensor of float32",
    "channels": "its features have shape (1, 2, 32, 32) instead of (1, 3, 32, 32)",
    "stride": "its features have shape (1, 3, 16, 16) instead of (1, 3, 32, 32)",
    "batch": "its features have shape (3, 32, 32) instead of (1, 3, 32, 32)",
    "nan": "its features are not all finite numbers",
    "integers": "it returned a Tensor of torch.uint8 instead of a tensor of float32",
}


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=5, size=(80, 64)))


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setenv(VARIABLE, REGISTERED)


@pytest.fixture(params=sorted(QUICK_PRESETS))
def settings(request):
    """Make a configuration from a preset of either solver."""

    def make(policy: str = "continue", **sections):
        return load_config(
            preset=request.param,
            overrides=QUICK_PRESETS[request.param],
            runtime={"on_plugin_failure": policy},
            **sections,
        )

    return make


def bad(fault: str, *at: int) -> dict:
    return {"name": "bad", "fault": fault, "at": list(at)}


def run(clip: SyntheticClip, config) -> list:
    return list(track(clip.images, mask=clip.masks[0], config=config))


def test_going_on_is_the_default():
    assert load_config().runtime.on_plugin_failure == "continue"


@pytest.fixture(scope="module", params=sorted(QUICK_PRESETS))
def failing_run(request, clip):
    """Make the answers of one run in which every fault of a plug-in has frames of its own, and a good one after."""

    def run_of_faults(section: str, faults: dict[str, str], frames_each: int) -> tuple[dict[str, int], list]:
        firsts = {fault: 2 + number * (frames_each + 1) for number, fault in enumerate(faults)}
        at = {first + n: fault for fault, first in firsts.items() for n in range(frames_each)}
        images = [clip.images[there_and_back(n)] for n in range(max(at) + 2)]
        config = load_config(
            preset=request.param,
            overrides=QUICK_PRESETS[request.param],
            **{"tracker": bad("raises"), section: {"name": "bad", "fault": at, "at": list(at)}},
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(VARIABLE, REGISTERED)
            return firsts, list(track(images, mask=clip.masks[0], config=config))

    return run_of_faults


@pytest.fixture(scope="module")
def tracker_faults(failing_run):
    return failing_run("tracker", TRACKER_FAULTS, 2)


@pytest.fixture(scope="module")
def encoder_faults(failing_run):
    return failing_run("features", ENCODER_FAULTS, 1)


@pytest.mark.parametrize(("fault", "told"), TRACKER_FAULTS.items())
def test_where_the_tracker_fails_its_last_mask_stands_in_and_the_reason_is_told(
    clip, tracker_faults, fault, told
):
    firsts, estimates = tracker_faults
    first = firsts[fault]
    assert [estimate.index for estimate in estimates] == list(range(len(estimates)))
    for index in (first, first + 1):
        estimate = estimates[index]
        assert estimate.failure.startswith("mask tracker 'bad' (TRACKING3D_PLUGINS ")
        assert told in estimate.failure
        assert estimate.reason.startswith(estimate.failure)
        assert estimate.status is not Status.TRACKED
        assert estimate.confidence <= 0.5
        np.testing.assert_array_equal(estimate.initial_mask, estimates[first - 1].initial_mask)
    for index in (0, 1, first - 1, first + 2):
        assert estimates[index].failure == ""
        expected = np.roll(clip.masks[0], there_and_back(index), axis=1)
        np.testing.assert_array_equal(estimates[index].initial_mask, expected)


@pytest.mark.parametrize(("fault", "told"), ENCODER_FAULTS.items())
def test_where_the_encoder_fails_the_initial_mask_is_the_answer_and_the_frame_is_lost(
    clip, encoder_faults, fault, told
):
    firsts, estimates = encoder_faults
    first = firsts[fault]
    lost = estimates[first]
    assert (lost.status, lost.confidence) == (Status.LOST, 0.0)
    assert lost.failure == lost.reason
    assert lost.failure.startswith("feature encoder 'bad' (TRACKING3D_PLUGINS ")
    assert told in lost.failure
    for mask in (lost.mask, lost.initial_mask):
        np.testing.assert_array_equal(mask, np.roll(clip.masks[0], there_and_back(first), axis=1))
    np.testing.assert_array_equal(lost.T_cam_obj, estimates[first - 1].T_cam_obj)
    assert lost.seconds > 0
    assert [estimates[index].failure for index in (0, 1, first - 1, first + 1)] == [""] * 4
    assert estimates[first + 1].status is not Status.LOST


def test_a_frame_in_which_both_fail_tells_both(clip, settings):
    estimate = run(clip, settings(tracker=bad("raises", 2), features=bad("nan", 2)))[2]
    assert "no pixels; feature encoder 'bad'" in estimate.failure
    np.testing.assert_array_equal(estimate.mask, np.roll(clip.masks[0], 1, axis=1))


def test_all_later_frames_may_fail(clip, settings):
    estimates = run(clip, settings(tracker=bad("raises", 1, 2, 3, 4), features=bad("raises", 1, 2, 3, 4)))
    assert [estimate.status for estimate in estimates[1:]] == [Status.LOST] * 4
    for estimate in estimates[1:]:
        np.testing.assert_array_equal(estimate.mask, clip.masks[0])


@pytest.mark.slow
def test_a_failed_frame_among_the_first_keeps_its_reason_when_it_is_answered_anew(clip):
    config = load_config(
        preset="rerendering",
        overrides=[*QUICK_PRESETS["rerendering"], "solver.init_frames=4"],
        tracker=bad("raises", 1),
    )
    estimates = run(clip, config)
    [revision] = [earlier for earlier in estimates[3].revised if earlier.index == 1]
    assert revision.failure == estimates[1].failure != ""
    assert revision.reason.startswith(revision.failure)
    assert revision.status is not Status.TRACKED
    assert all(not earlier.failure for earlier in estimates[3].revised if earlier.index != 1)


@pytest.mark.parametrize(("section", "kind"), [("tracker", "mask tracker"), ("features", "feature encoder")])
def test_with_stop_the_run_ends_and_the_message_names_plugin_version_and_frame(clip, section, kind, settings):
    config = settings("stop", **{"tracker": bad("raises"), section: bad("raises", 2)})
    estimates = track(clip.images, mask=clip.masks[0], config=config)
    assert [next(estimates).index for _ in range(2)] == [0, 1]
    told = rf"^{kind} 'bad' \(TRACKING3D_PLUGINS [0-9a-f]{{12}}\) failed at frame 2: ZeroDivisionError: no \w+\.$"
    with pytest.raises(PluginError, match=told) as caught:
        next(estimates)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize("policy", ["continue", "stop"])
@pytest.mark.parametrize(
    ("section", "fault", "told"),
    [
        ("tracker", "raises", r"mask tracker 'bad' .* failed at frame 0: ZeroDivisionError: no pixels\.$"),
        ("tracker", "shape", r"mask tracker 'bad' .* failed at frame 0: its mask has shape"),
        ("features", "raises", r"feature encoder 'bad' .* failed at frame 0: ZeroDivisionError"),
        ("features", "nan", r"feature encoder 'bad' .* failed at frame 0: its features are not all finite"),
    ],
)
def test_in_the_first_frame_any_failure_ends_the_run(clip, policy, section, fault, told, settings):
    config = settings(policy, **{"tracker": bad("raises"), section: bad(fault, 0)})
    with pytest.raises(PluginError, match=told):
        run(clip, config)


def test_what_the_tracker_refuses_to_start_on_is_told_in_its_own_words(clip, settings):
    with pytest.raises(InputError, match=r"^The third mask is missing\.$"):
        run(clip, settings(tracker=bad("refuses", 0)))


def test_an_encoder_whose_attributes_cannot_be_used_is_refused_before_the_first_frame(clip, settings):
    with pytest.raises(
        PluginError, match=r"'bad' .* is broken: its channels is 0 instead of a positive integer"
    ):
        Session(settings(features=bad("attribute")), Prompt((0, 0, 9, 9), clip.masks[0]))


@pytest.fixture
def source(clip, tmp_path):
    folder = tmp_path / "clip"
    folder.mkdir()
    for index, image in enumerate(clip.images):
        write_image(folder / f"{index:03d}.png", image)
    return open_source(str(folder))


def test_the_run_folder_records_every_failure_and_the_summary_counts_them(clip, source, tmp_path, settings):
    config = settings(tracker=bad("raises", 1, 2, 4), features=bad("nan", 1))
    record(source, config, tmp_path / "run", mask=clip.masks[0])
    reader = RunReader(tmp_path / "run")
    assert reader.state == "finished"
    assert [bool(frame.failure) for frame in reader.frames] == [False, True, True, False, True]
    description = json.loads((tmp_path / "run" / "run.json").read_text())
    assert description["counts"]["failed"] == 3
    commonest, other = description["failures"]
    assert (commonest["frames"], other["frames"]) == (2, 1)
    assert commonest["reason"] == reader.frames[2].failure
    assert "no pixels" in commonest["reason"] and "not all finite" in other["reason"]


def test_with_stop_the_finished_frames_are_kept(clip, source, tmp_path, settings):
    with pytest.raises(PluginError, match=r"failed at 002\.png") as caught:
        record(source, settings("stop", tracker=bad("raises", 2)), tmp_path / "run", mask=clip.masks[0])
    assert "The frames finished until then are in" in caught.value.__notes__[0]
    reader = RunReader(tmp_path / "run")
    assert (reader.state, [frame.index for frame in reader.frames]) == ("failed", [0, 1])
    assert "no pixels" in reader.description["error"]


def test_nothing_reads_any_more_once_a_run_has_failed(clip, source, tmp_path, settings):
    """Whoever keeps the error keeps its frames alive, and with them whatever is only left to be forgotten."""
    before = set(threading.enumerate())
    with pytest.raises(PluginError) as caught:
        record(source, settings("stop", tracker=bad("raises", 2)), tmp_path / "run", mask=clip.masks[0])
    left = [one.name for one in set(threading.enumerate()) - before]
    assert caught.value.__traceback__ is not None
    assert not [name for name in left if name.startswith("tracking3d-reading")]


def test_the_summary_on_the_screen_says_how_many_frames_failed_and_why(
    clip, source, tmp_path, capsys, settings
):
    from tracking3d.cli.summary import print_summary

    record(source, settings(tracker=bad("raises", 1, 2)), tmp_path / "run", mask=clip.masks[0])
    print_summary(tmp_path / "run")
    shown = capsys.readouterr().out
    [count] = [line for line in shown.splitlines() if "plug-in failure" in line]
    [reason] = [line for line in shown.splitlines() if "no pixels" in line]
    assert "│ 2" in count
    assert "2 of them" in reason
