"""A picture that repeats the one before to the bit is not tracked again: its frame gets the answers of that one."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from refining_solver import StandInSolver
from resumable_runs import Stopped, assert_alike, settings, stop_at

from tracking3d.frames import SkippedFrame
from tracking3d.pipeline.correct import correct_run
from tracking3d.pipeline.open_tracking import request_tracking
from tracking3d.pipeline.record import RecordOptions, record, record_tracking
from tracking3d.pipeline.session import Session
from tracking3d.results import layout, run_writer
from tracking3d.results.checkpoint import folder as checkpoint_folder
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import image_sequence, open_source
from tracking3d.video.opening import without_repeats

FRAMES = 5
SHOWN = [0, 1, 1, 1, 2, 3, 3, 4]
"""Which picture of the clip each frame shows."""
FIRST = {2: 1, 3: 1, 6: 5}
"""Frames that repeat the picture before, and the frame that shows it first."""


@pytest.fixture(autouse=True)
def every_frame(monkeypatch, stand_in_solver):
    monkeypatch.setattr(checkpoint_folder, "_FIRST_GAP", 1)


@pytest.fixture(scope="module")
def still(clip, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("still")
    for index, picture in enumerate(SHOWN):
        write_image(folder / f"{index:03d}.png", clip.images[picture])
    return folder


def run(clip, still, folder: Path, *overrides: str, **given) -> RunReader:
    given.setdefault("mask", clip.masks[SHOWN[given.get("start_frame") or 0]])
    return record(open_source(str(still)), settings("object.refine_masks=false", *overrides), folder, **given)


def assert_repeats(reader: RunReader, repeats: dict[int, int] = FIRST) -> None:
    """Every frame has a line, and repeated pictures have the answers of the picture before."""
    frames = {one.index: one for one in reader.frames}
    assert list(frames) == list(range(len(SHOWN)))
    assert reader.description["skipped"] == []
    assert reader.description["counts"]["frames"] == len(SHOWN)
    for index, first in repeats.items():
        mine, expected = frames[index], frames[first]
        np.testing.assert_array_equal(mine.T_cam_obj, expected.T_cam_obj)
        assert (mine.status, mine.area, mine.refined) == (expected.status, expected.area, expected.refined)
        assert (mine.name, mine.seconds) == (f"{index:03d}.png", 0.0)
        assert mine.hypothesis == f"that of frame {first}"
        np.testing.assert_array_equal(reader.mask(index), reader.mask(first))
        np.testing.assert_array_equal(reader.initial_mask(index), reader.initial_mask(first))


@pytest.mark.parametrize("refines", [True, False])
def test_repeated_pictures_get_the_answers_of_the_one_before(clip, still, tmp_path, refines):
    run(clip, still, tmp_path / "run", f"solver.final_refine={str(refines).lower()}")
    assert {index for index, _ in StandInSolver.seen}.isdisjoint(FIRST)
    assert refines == bool(StandInSolver.seen)
    for refined in (True, False):
        assert_repeats(RunReader(tmp_path / "run", refined))
    assert RunReader(tmp_path / "run").frames[2].refined is refines
    with av.open(str(tmp_path / "run" / layout.OVERLAY)) as video:
        assert sum(1 for _ in video.decode(video=0)) == FRAMES


@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [(Session, "step", 2), (Session, "step", 4), (Session, "refine_frame", 2)],
    ids=["after a repeat", "at the last frame", "in the refinement"],
)
@pytest.mark.parametrize("killed", [False, True], ids=["stopped", "killed"])
def test_a_stopped_run_with_repeated_pictures_goes_on_to_the_same_end(
    clip, still, tmp_path, monkeypatch, owner, name, call, killed
):
    run(clip, still, tmp_path / "whole")
    with monkeypatch.context() as patch:
        stop_at(patch, owner, name, call)
        if killed:  # repeats are not written at the end
            patch.setattr(run_writer.RunWriter, "_write_repeats", lambda self: None)
        with pytest.raises(Stopped):
            run(clip, still, tmp_path / "run")
    if name == "step" and not killed:
        assert [one.index for one in RunReader(tmp_path / "run").frames] == [
            0,
            1,
            2,
            3,
            *([4, 5, 6] if call == 4 else []),
        ]
    run(clip, still, tmp_path / "run", resume=True)
    assert_repeats(RunReader(tmp_path / "run"))
    assert_alike(tmp_path / "run", tmp_path / "whole")


@pytest.mark.parametrize("corrected", [2, 4])
def test_a_repeated_picture_can_be_corrected(clip, still, tmp_path, corrected):
    mask = np.roll(clip.masks[SHOWN[corrected]], 2, axis=1)
    correction = Correction(corrected, mask=mask)
    run(clip, still, tmp_path / "run")
    correct_run(tmp_path / "run", [correction])
    repeats = {3: 2, 6: 5} if corrected == 2 else FIRST
    assert_repeats(RunReader(tmp_path / "run"), repeats)
    np.testing.assert_array_equal(RunReader(tmp_path / "run").initial_mask(corrected), mask)
    run(clip, still, tmp_path / "whole", corrections=[correction])
    for mine, expected in zip(
        RunReader(tmp_path / "run").frames, RunReader(tmp_path / "whole").frames, strict=True
    ):
        np.testing.assert_allclose(mine.T_cam_obj, expected.T_cam_obj)
        assert mine.area == expected.area


def test_a_killed_run_takes_the_correction_of_a_repeated_picture(clip, still, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(patch, Session, "step", 3)
        patch.setattr(run_writer.RunWriter, "_write_repeats", lambda self: None)
        with pytest.raises(Stopped):
            run(clip, still, tmp_path / "run")
    mask = np.roll(clip.masks[1], 2, axis=1)
    run(clip, still, tmp_path / "run", corrections=[Correction(2, mask=mask)], resume=True)
    assert_repeats(RunReader(tmp_path / "run"), {3: 2, 6: 5})
    np.testing.assert_array_equal(RunReader(tmp_path / "run").initial_mask(2), mask)


def test_the_prompt_may_be_of_a_repeated_picture(clip, still, tmp_path):
    run(clip, still, tmp_path / "run", start_frame=6)
    assert_repeats(RunReader(tmp_path / "run"), {2: 1, 3: 1})
    assert not RunReader(tmp_path / "run").frames[6].hypothesis.startswith("that of")


def test_a_run_of_the_first_pass_alone_has_all_its_lines(clip, still, tmp_path):
    """As the parts of a split video are."""
    request = request_tracking(
        open_source(str(still)), settings(), PromptSet.of_one(mask=clip.masks[0]), skip_damaged=True
    )
    [reader] = record_tracking(request, tmp_path / "run", RecordOptions(first_pass_only=True))
    assert_repeats(reader)


def test_equal_files_are_decoded_once(still, monkeypatch):
    read, decoded = image_sequence.read_image, []
    monkeypatch.setattr(image_sequence, "read_image", lambda file: decoded.append(file) or read(file))
    frames = list(without_repeats(open_source(str(still)), [6]))
    assert {one.index: one.repeats for one in frames if isinstance(one, SkippedFrame)} == {2: 1, 3: 1}
    assert len(decoded) == FRAMES
    decoded.clear()
    assert len(list(open_source(str(still)))) == len(decoded) == len(SHOWN)
