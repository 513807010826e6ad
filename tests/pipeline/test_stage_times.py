"""Every second of a frame is recorded, in the stage that it was spent in."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from sleeping_plugins import ENCODING, TRACKING

from tracking3d import load_config, track
from tracking3d.pipeline.record import record, record_objects
from tracking3d.plugins import VARIABLE
from tracking3d.results import overlay
from tracking3d.results.description import time_per_frame
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.stage_times import STAGES, StageTimes, in_stage, measure
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.video import open_source
from tracking3d.video.image_sequence import ImageSequence

HERE = Path(__file__).parent
QUICK = ["crop.size=32", "object.frequency=2", "object.texture_size=16", "camera.fov=45"]
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
FRAMES, DECODING, DRAWING = 5, 0.03, 0.02
LATE = 0.5  # seconds that a busy machine, or a network that is read, may add to a sleep


@pytest.fixture(scope="module")
def clip():
    return synthesize(SyntheticSpec(frames=FRAMES, size=(80, 64)))


@pytest.fixture(autouse=True)
def slow(monkeypatch):
    """Tracker, encoder, decoding and drawing take a known time."""
    file = HERE / "sleeping_plugins.py"
    monkeypatch.setenv(
        VARIABLE,
        f"tracking3d.trackers:slow={file}:SleepingTracker;tracking3d.features:slow={file}:SleepingEncoder",
    )
    decode, draw = ImageSequence.__iter__, overlay.draw_overlay

    def slowly_decoded(self):
        for frame in decode(self):
            time.sleep(DECODING)
            yield frame

    def slowly_drawn(*given):
        time.sleep(DRAWING)
        return draw(*given)

    monkeypatch.setattr(ImageSequence, "__iter__", slowly_decoded)
    monkeypatch.setattr("tracking3d.results.pictures.draw_overlay", slowly_drawn)


@pytest.fixture
def source(clip, tmp_path):
    (tmp_path / "clip").mkdir()
    for index, image in enumerate(clip.images):
        write_image(tmp_path / "clip" / f"{index:03d}.png", image)
    return open_source(str(tmp_path / "clip"))


def settings(preset, **sections):
    return load_config(
        preset=preset,
        overrides=QUICK_PRESETS[preset],
        tracker={"name": "slow"},
        features={"name": "slow"},
        **sections,
    )


def slept(seconds, expected):
    return expected <= seconds < expected + LATE


PRESETS = pytest.mark.parametrize("preset", QUICK_PRESETS)


@PRESETS
def test_every_frame_of_a_run_has_its_stages_and_their_sum(preset, source, clip, tmp_path):
    started = time.perf_counter()
    record(source, settings(preset), tmp_path / "run", mask=clip.masks[0])
    took = time.perf_counter() - started
    causal = RunReader(tmp_path / "run", refined=False)
    assert len(causal.frames) == FRAMES
    for frame in causal.frames:
        stages = frame.stages
        drawn = DRAWING if frame.index else 0  # the picture of the frame before
        assert slept(stages.decode, DECODING)
        assert slept(stages.track, TRACKING)
        assert stages.encode >= ENCODING
        assert stages.write > drawn
        assert stages.solve > 0
        assert frame.seconds == pytest.approx(stages.whole)
    run = RunReader(tmp_path / "run").description
    summed = run["timings"]["stages"]
    for stage in STAGES:
        assert summed[stage] == pytest.approx(sum(getattr(one.stages, stage) for one in causal.frames))
    assert summed["map"] > 0 or preset == "default"  # without motion the online solver waits
    assert sum(summed.values()) == pytest.approx(FRAMES * run["timings"]["seconds_per_frame_mean"])
    whole, stages = time_per_frame(run)
    assert whole == pytest.approx(stages.whole)
    # What is not of a frame is what is made once: the mesh, the contact sheet, the solver's start.
    # Reading and writing go on beside the rest.
    assert FRAMES * (whole - stages.decode - stages.write) < took


def test_the_second_look_has_its_own_stages(source, clip, tmp_path):
    record(source, settings("default"), tmp_path / "run", mask=clip.masks[0])
    refined = RunReader(tmp_path / "run").frames
    assert all(frame.refined for frame in refined)
    for frame in refined:
        assert slept(frame.stages.decode, DECODING)
        assert frame.stages.track == 0  # the masks are kept
        assert frame.stages.write >= DRAWING
    run = RunReader(tmp_path / "run").description
    again = run["refinement"]["stages"]
    assert again["decode"] == pytest.approx(sum(frame.stages.decode for frame in refined))
    assert again["map"] >= sum(frame.stages.map for frame in refined)
    causal = run["timings"]["seconds_per_frame_mean"]
    assert time_per_frame(run)[0] == pytest.approx(causal + sum(again.values()) / FRAMES)


def test_several_objects_share_what_a_frame_takes_to_decode(source, clip, tmp_path):
    masks = [clip.masks[0], clip.masks[0]]
    record_objects(source, settings("rerendering"), tmp_path / "run", masks=masks)
    for folder in ("object_0", "object_1"):
        for frame in RunReader(tmp_path / "run" / folder).frames:
            assert slept(frame.stages.decode, DECODING / 2)
            assert slept(frame.stages.track, TRACKING)


@PRESETS
def test_track_times_what_it_does_itself_and_the_reading(preset, clip):
    estimates = list(track(clip.images, mask=clip.masks[0], config=settings(preset)))
    for estimate in estimates:
        assert slept(estimate.stages.track, TRACKING)
        assert estimate.stages.encode >= ENCODING
        assert estimate.stages.decode > 0 == estimate.stages.write
        assert estimate.seconds == estimate.stages.whole


def test_a_run_of_an_older_version_is_read(source, clip, tmp_path):
    run = tmp_path / "run"
    record(source, settings("rerendering"), run, mask=clip.masks[0])
    lines = [json.loads(line) for line in (run / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        del line["stages"], line["mask_source"]
    (run / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    description = json.loads((run / "run.json").read_text())
    del description["timings"]["stages"], description["counts"]["masks"], description["notes"]
    (run / "run.json").write_text(json.dumps(description))
    old = RunReader(run)
    assert [frame.stages for frame in old.frames] == [None] * FRAMES
    assert [frame.mask_source for frame in old.frames] == [None] * FRAMES
    assert old.frames[0].seconds == lines[0]["seconds"] > TRACKING
    assert time_per_frame(old.description) == (description["timings"]["seconds_per_frame_mean"], None)


def test_a_stage_within_a_stage_stops_the_outer_one():
    with measure("solve") as watch:
        time.sleep(0.02)
        with in_stage("map"), in_stage("encode"):
            time.sleep(0.03)
        time.sleep(0.02)
    times = watch.times
    assert 0.04 <= times.solve < 0.04 + LATE and 0.03 <= times.encode < 0.03 + LATE
    assert times.map < 0.01 and times.whole == pytest.approx(times.solve + times.encode + times.map)


def test_a_stage_that_fails_is_over():
    with measure("solve") as watch:
        with pytest.raises(ZeroDivisionError), in_stage("track"):
            raise ZeroDivisionError
        time.sleep(0.02)
    assert watch.times.solve >= 0.02 > watch.times.track


def test_without_a_stopwatch_nothing_is_timed():
    with in_stage("map"):
        pass
    assert StageTimes() + StageTimes(map=2) * 0.5 == StageTimes(map=1)
