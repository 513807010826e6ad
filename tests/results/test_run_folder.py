"""The run folder: what is written can be read, whatever happens in between."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from forked import forked_script
from recorded_runs import set_format

from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.estimate import FREE_ROTATION, Status
from tracking3d.frames import SkippedFrame
from tracking3d.results import layout
from tracking3d.results.overwrite import clear_run_folder
from tracking3d.results.run_reader import RunReader


def test_what_is_written_is_read_back(tmp_path, turning_sphere, write_run):
    write_run(tmp_path / "deep" / "run", turning_sphere)
    run = RunReader(tmp_path / "deep" / "run")
    assert run.state == "finished"
    assert run.camera == turning_sphere.camera
    assert run.config == {"solver": {"name": "paper", "iterations": 500}}
    assert [record.index for record in run.frames] == list(range(8))
    for record, estimate, frame in zip(
        run.frames, turning_sphere.estimates, turning_sphere.frames, strict=True
    ):
        assert np.array_equal(record.T_cam_obj, estimate.T_cam_obj)
        assert (record.name, record.time, record.status) == (frame.name, frame.time, estimate.status)
        assert (record.losses, record.confidence) == (estimate.losses, estimate.confidence)
        assert (record.keyframe, record.iterations) == (estimate.keyframe, 12)
        assert record.seconds > 0.25  # writing comes on top
        assert np.array_equal(run.mask(record.index), estimate.mask)
        assert np.array_equal(run.initial_mask(record.index), estimate.initial_mask)
        both = estimate.mask & estimate.initial_mask
        assert record.iou_initial == both.sum() / (estimate.mask | estimate.initial_mask).sum()
        assert record.area == estimate.mask.sum()
    assert len(run.mesh().faces) == len(turning_sphere.model.faces)


def test_run_json_says_how_the_run_was_made_and_what_came_of_it(tmp_path, turning_sphere, start_run):
    with start_run(tmp_path, turning_sphere) as writer:
        writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
        writer.skip(SkippedFrame(1, "cannot be decoded"))
        lost = dataclasses.replace(turning_sphere.estimates[2], status=Status.LOST, seconds=0.75)
        writer.write(lost, turning_sphere.frames[2])
        writer.finish(turning_sphere.model, "finished")
    run = json.loads((tmp_path / "run.json").read_text())
    assert run["counts"] == {
        "frames": 2,
        "tracked": 1,
        "uncertain": 0,
        "lost": 1,
        "keyframes": 1,
        "skipped": 1,
        "failed": 0,
        "masks": {
            "rendered": 0,
            "fused": 0,
            "initial": 0,
            "none": 0,
        },  # these estimates do not say
    }
    assert run["skipped"] == [{"index": 1, "reason": "cannot be decoded"}]
    assert run["timings"]["seconds_per_frame_mean"] == run["timings"]["seconds_per_frame_median"]
    assert run["timings"]["seconds_per_frame_mean"] > 0.5  # writing comes on top
    assert run["timings"]["seconds_total"] == run["timings"]["passes"]["tracking"] > 0
    assert run["seed"] == 7
    assert run["source"] == "clip.mp4"
    assert run["camera"]["origin"] == "default field of view"
    assert {"tracking3d", "python", "torch", "kornia", "opencv", "numpy", "platform"} <= run[
        "versions"
    ].keys()
    assert all(run["versions"].values())
    assert "x_cam = R x_obj + t" in run["conventions"]["T_cam_obj"]
    assert run["created"] <= run["finished"]
    assert 0.9 < run["iou_initial_mean"] < 1


def test_masks_are_black_and_white_at_full_resolution_named_by_index(tmp_path, turning_sphere, start_run):
    frame = dataclasses.replace(turning_sphere.frames[3], index=1234567)
    with start_run(tmp_path, turning_sphere) as writer:
        writer.write(dataclasses.replace(turning_sphere.estimates[3], index=1234567), frame)
        writer.write(
            dataclasses.replace(turning_sphere.estimates[0], index=2000000, initial_mask=None), frame
        )
    with av.open(str(tmp_path / "masks" / "1234567.png")) as png:
        pixels = next(png.decode(video=0)).to_ndarray(format="gray")
    assert pixels.shape == (120, 160)
    assert set(np.unique(pixels)) == {0, 255}
    assert sorted(path.name for path in (tmp_path / "initial_masks").iterdir()) == ["1234567.png"]
    assert RunReader(tmp_path).initial_mask(2000000) is None
    assert RunReader(tmp_path).frames[1].iou_initial is None


def test_the_overlay_is_a_video_of_every_frame(tmp_path, turning_sphere, write_run):
    write_run(tmp_path, turning_sphere)
    with av.open(str(tmp_path / "overlay.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert video.streams.video[0].codec_context.name == "h264"
        assert video.streams.video[0].average_rate == 30
    assert len(frames) == 8
    assert frames[0].shape[1] == 320  # small frames are enlarged until their text can be read


def test_a_running_run_can_be_read(tmp_path, turning_sphere, start_run):
    with start_run(tmp_path, turning_sphere) as writer:
        assert RunReader(tmp_path).frames == []
        for count in (1, 2, 3):
            writer.write(turning_sphere.estimates[count - 1], turning_sphere.frames[count - 1])
            run = RunReader(tmp_path)
            assert (run.state, len(run.frames)) == ("running", count)
            assert np.array_equal(run.mask(count - 1), turning_sphere.estimates[count - 1].mask)
        with pytest.raises(InputError, match=r"holds no mesh\.obj"):
            run.mesh()
    assert RunReader(tmp_path).state == "interrupted"


def test_a_revision_replaces_the_earlier_answer(tmp_path, turning_sphere, start_run):
    first, second, third = turning_sphere.estimates[:3]
    better = dataclasses.replace(
        first, T_cam_obj=third.T_cam_obj, mask=third.mask, initial_mask=None, status=Status.TRACKED
    )
    with start_run(tmp_path, turning_sphere) as writer:
        writer.write(dataclasses.replace(first, status=Status.UNCERTAIN), turning_sphere.frames[0])
        writer.write(dataclasses.replace(second, revised=(better,)), turning_sphere.frames[1])
    lines = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert [(line["index"], line["revision"]) for line in lines] == [(0, False), (0, True), (1, False)]
    run = RunReader(tmp_path)
    assert [record.index for record in run.frames] == [0, 1]
    record = run.frames[0]
    assert (record.status, record.revision, record.name) == (Status.TRACKED, True, "000000.jpg")
    assert np.array_equal(record.T_cam_obj, third.T_cam_obj)
    assert np.array_equal(run.mask(0), third.mask)
    assert np.array_equal(run.initial_mask(0), first.initial_mask)
    assert (
        record.iou_initial
        == (third.mask & first.initial_mask).sum() / (third.mask | first.initial_mask).sum()
    )
    assert run.description["counts"]["uncertain"] == 0


def test_a_free_axis_is_in_the_line_and_told_in_the_notes(tmp_path, turning_sphere, start_run):
    free = dataclasses.replace(turning_sphere.estimates[1], free_axis=np.array([0.0, 0.6, -0.8]))
    with start_run(tmp_path, turning_sphere) as writer:
        writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
        writer.write(free, turning_sphere.frames[1])
    run = RunReader(tmp_path)
    assert [record.free_axis for record in run.frames] == [None, (0.0, 0.6, -0.8)]
    assert FREE_ROTATION in run.description["notes"]


def test_what_is_not_a_number_is_null(tmp_path, turning_sphere, start_run):
    bad = dataclasses.replace(
        turning_sphere.estimates[0],
        T_cam_obj=np.full((4, 4), np.nan),
        confidence=math.nan,
        losses={"appearance": math.inf, "silhouette": math.nan},
        mask=np.zeros((120, 160), dtype=bool),
        initial_mask=np.zeros((120, 160), dtype=bool),
        status=Status.LOST,
    )
    with start_run(tmp_path, turning_sphere, config={"tau": math.nan, "path": Path("a")}) as writer:
        writer.write(bad, turning_sphere.frames[0])
    for text in [(tmp_path / "run.json").read_text(), (tmp_path / "frames.jsonl").read_text()]:
        json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    run = RunReader(tmp_path)
    assert run.config == {"tau": None, "path": "a"}
    record = run.frames[0]
    assert np.isnan(record.T_cam_obj).all()
    assert math.isnan(record.confidence)
    assert math.isnan(record.losses["appearance"])
    assert record.iou_initial is None


@pytest.mark.parametrize("cut", [1, 5, 100, 300])
def test_a_last_line_that_was_cut_off_costs_that_frame_only(tmp_path, turning_sphere, cut, write_run):
    write_run(tmp_path, turning_sphere)
    lines = tmp_path / "frames.jsonl"
    whole = lines.read_bytes()
    lines.write_bytes(whole[:-cut])
    # A line that lacks nothing but its end mark is whole.
    assert len(RunReader(tmp_path).frames) == (8 if cut == 1 else 7)


def test_a_damaged_line_in_the_middle_is_named(tmp_path, turning_sphere, write_run):
    write_run(tmp_path, turning_sphere)
    lines = (tmp_path / "frames.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "frames.jsonl").write_text("".join([*lines[:2], lines[2][:50] + "\n", *lines[3:]]))
    with pytest.raises(InputError, match="Line 3 of"):
        _ = RunReader(tmp_path).frames


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "holds no run.json"),
        ("", "is damaged"),
        ("[1]", "not written by tracking3d"),
        ('{"state": "finished"}', "not written by tracking3d"),
        ('{"format": "tracking3d-run", "format_version": 99}', "update tracking3d"),
    ],
)
def test_what_is_not_a_run_folder_is_said_in_one_sentence(tmp_path, text, message):
    if text is not None:
        (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=message) as error:
        RunReader(tmp_path)
    assert "\n" not in str(error.value)


def test_a_run_of_an_earlier_format_is_refused_and_can_be_replaced(tmp_path, turning_sphere, write_run):
    write_run(tmp_path, turning_sphere)
    set_format(tmp_path, 1)
    with pytest.raises(
        InputError, match=r"an earlier version of tracking3d \(format 1\); run it again with overwrite=True"
    ):
        RunReader(tmp_path)
    with pytest.raises(OutputError, match="already holds a run"):
        clear_run_folder(tmp_path, overwrite=False)
    clear_run_folder(tmp_path, overwrite=True)
    assert not (tmp_path / layout.OBJ).exists()


def test_a_folder_that_does_not_exist_is_no_run(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        RunReader(tmp_path / "nowhere")


KILLED = """
import os, signal, sys
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from turning_sphere import turning_sphere_of
from tracking3d.results import pictures, run_writer
from tracking3d.results.description import RunHeader

def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)

clip = turning_sphere_of(6)
about = {"config": {}, "camera": clip.camera, "source": "clip", "seed": 0, "fps": None, "command": None}
where = None
for name in sys.argv[3:]:  # every run has a process of its own, and only this one starts from nothing
    if child := os.fork():
        assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    else:
        where = name
        break
if where is None:
    sys.exit(0)
writer = run_writer.RunWriter(Path(sys.argv[1]) / where, RunHeader(**about))
for frame, estimate in zip(clip.frames[:4], clip.estimates[:4]):
    writer.write(estimate, frame)
if where == "masks":  # the fifth frame's masks are there, its line is not
    writer._lines.append = die
elif where == "line":  # half of its line is there
    file = writer._lines._file
    whole = file.write
    file.write = lambda line: (whole(line[:60]), die())
elif where == "overlay":  # all of it is there but the overlay
    pictures.draw_overlay = die
elif where == "finish":
    writer.finish = die
    writer.finish()
writer.write(clip.estimates[4], clip.frames[4])
"""


KEPT = {"masks": 4, "line": 4, "overlay": 5, "finish": 4}
"""Where a run is killed within its fifth frame, and how many frames it keeps."""


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """A folder of runs by where each was killed."""
    folder = tmp_path_factory.mktemp("killed")
    ended = forked_script(folder, KILLED, folder, Path(__file__).parents[1], *KEPT)
    assert ended.returncode == 0, ended.stderr
    return folder


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
@pytest.mark.parametrize(("where", "kept"), KEPT.items())
def test_a_killed_run_loses_at_most_the_current_frame(killed, turning_sphere, where, kept, start_run):
    folder = killed / where
    run = RunReader(folder)
    assert run.state == "interrupted"
    assert [record.index for record in run.frames] == list(range(kept))
    for record in run.frames:
        assert np.count_nonzero(run.mask(record.index)) == record.area > 0
        assert run.initial_mask(record.index) is not None
    if kept > 1:  # the muxer holds the last frame back
        with av.open(str(folder / "overlay.mp4")) as video:
            assert kept - 2 <= sum(1 for _ in video.decode(video=0)) <= kept
    # The dead process holds nothing: the folder can be used again, and nothing of the old run stays.
    with pytest.raises(OutputError, match="already holds a run"):
        start_run(folder, turning_sphere)
    with start_run(folder, turning_sphere, overwrite=True) as writer:
        writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
    assert [path.name for path in (folder / "masks").iterdir()] == ["000000.png"]
    assert len(RunReader(folder).frames) == 1


def test_ctrl_c_keeps_what_is_finished(tmp_path, turning_sphere, start_run):
    with pytest.raises(KeyboardInterrupt), start_run(tmp_path, turning_sphere) as writer:
        for frame, estimate in zip(turning_sphere.frames, turning_sphere.estimates, strict=True):
            if frame.index == 5:
                raise KeyboardInterrupt
            writer.write(estimate, frame)
    run = RunReader(tmp_path)
    assert (run.state, len(run.frames)) == ("interrupted", 5)
    assert (tmp_path / "contact_sheet.png").is_file()
    with av.open(str(tmp_path / "overlay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) == 5


def test_an_error_on_the_way_is_recorded(tmp_path, turning_sphere, start_run):
    with pytest.raises(RuntimeError), start_run(tmp_path, turning_sphere) as writer:
        writer.write(turning_sphere.estimates[0], turning_sphere.frames[0])
        raise RuntimeError("the solver broke")
    run = RunReader(tmp_path)
    assert (run.state, run.description["error"], len(run.frames)) == ("failed", "the solver broke", 1)


def test_a_run_without_a_frame_is_a_run(tmp_path, turning_sphere, start_run):
    with start_run(tmp_path, turning_sphere) as writer:
        writer.finish(None, "failed", "no frame could be decoded")
        writer.finish(None, "finished")  # only the first call counts
    run = RunReader(tmp_path)
    assert (run.state, run.frames) == ("failed", [])
    assert run.description["counts"]["frames"] == 0
    assert not (tmp_path / "overlay.mp4").exists()
