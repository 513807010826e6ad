"""Corrections of frames and objects that do not exist are refused, and the sentence names those that do."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from refining_solver import StandInSolver

from tracking3d import load_config, track, track_objects
from tracking3d.errors import InputError
from tracking3d.frames import Frame
from tracking3d.pipeline.correct import correct_run, object_folders_of
from tracking3d.pipeline.record import record, record_objects
from tracking3d.pipeline.session import SOLVERS
from tracking3d.results.files import write_image
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.prompts.corrections import Correction, parse_correction, validate_corrections
from tracking3d.video import open_source
from tracking3d.video.source import known_indices
from tracking3d.video.writer import VideoWriter

BOX = (20.0, 16.0, 40.0, 32.0)
FAR = Correction(99, box=BOX)


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=3, size=(80, 64), supersample=1, degrees_per_frame=4))


@pytest.fixture(autouse=True)
def quick_solver(monkeypatch):
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)


def settings():
    quick = [
        "tracker.name=flow",
        "tracker.segmentation_size=64",
        "crop.size=32",
        "object.frequency=2",
        "camera.fov=45",
    ]
    return load_config(overrides=[*quick, "object.adjustment_views=0", "object.refine_masks=false"])


@pytest.fixture
def images(clip, tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    for index, image in enumerate(clip.images):
        write_image(tmp_path / "clip" / f"{index:03d}.png", image)
    return tmp_path / "clip"


def test_the_library_refuses_a_frame_beyond_the_end_and_says_how_many_there_are(clip):
    for frames in (clip.images, list(clip.images)):
        with pytest.raises(InputError, match=r"frame 99 is not among .*: these are 3 frames, from 0 to 2"):
            next(track(frames, mask=clip.masks[0], corrections=[FAR], config=settings()))
    with pytest.raises(InputError, match="these are 3 frames, from 0 to 2"):
        next(track_objects(clip.images, masks=[clip.masks[0]], corrections=[FAR], config=settings()))


def test_frames_with_indices_of_their_own_are_corrected_by_these(clip):
    frames = [Frame(10 * number, image) for number, image in enumerate(clip.images, 1)]
    with pytest.raises(InputError, match=r"frame 2 is not among .*: these are 3 frames, from 10 to 30"):
        next(track(frames, mask=clip.masks[0], corrections=[Correction(2, box=BOX)], config=settings()))
    given = [Correction(30, box=BOX)]
    assert len(list(track(frames, mask=clip.masks[0], corrections=given, config=settings()))) == 3


@pytest.mark.parametrize("saved", [True, False], ids=["with a result", "one by one"])
def test_a_source_of_unknown_length_says_so_at_its_end_and_keeps_all_estimates(clip, caplog, saved):
    tracking = track(iter(clip.images), mask=clip.masks[0], corrections=[FAR], config=settings())
    count = len(tracking.result().poses) if saved else len(list(tracking))
    assert count == 3
    assert (
        "Frame 99, which was to be corrected, could not be read: there are 3 frames, the last of them 2"
        in caplog.text
    )


def test_a_video_knows_its_frames_if_its_header_counts_them(clip, tmp_path):
    with_count = tmp_path / "clip.mp4"
    writer = cv2.VideoWriter(
        str(with_count), cv2.VideoWriter.fourcc(*"mp4v"), 25, clip.images[0].shape[1::-1]
    )
    for image in clip.images:
        writer.write(image)
    writer.release()
    assert known_indices(open_source(str(with_count))) == range(3)
    assert known_indices(open_source(str(with_count), "1:9")) == range(1, 3)
    assert known_indices(open_source(iter(clip.images))) is None
    uncounted = tmp_path / "growing.mp4"  # in fragments, so that the header is written before the frames
    with closing(VideoWriter(uncounted, 25, clip.images[0].shape[:2])) as growing:
        for image in clip.images:
            growing.write(image)
        assert known_indices(open_source(str(uncounted))) is None
        assert known_indices(open_source(str(uncounted), "0:2")) == range(2)


def test_a_run_names_its_frames_and_the_reason_of_those_that_it_skipped(clip, images, tmp_path):
    (images / "001.png").write_bytes(b"no image")
    record(open_source(str(images)), settings(), tmp_path / "run", mask=clip.masks[0])
    before = (tmp_path / "run" / "run.json").read_bytes()
    with pytest.raises(InputError, match=r"frame 500 is not among .*: these are 2 frames, from 0 to 2"):
        correct_run(tmp_path / "run", [Correction(500, box=BOX)])
    with pytest.raises(InputError, match=r"frame 1 of the run .*run has no estimate, because .*001\.png"):
        correct_run(tmp_path / "run", [Correction(1, box=BOX)])
    assert (tmp_path / "run" / "run.json").read_bytes() == before
    assert not (tmp_path / "run" / ".correcting").exists()


def test_of_several_objects_the_corrected_one_has_to_be_named(clip, images, tmp_path):
    given = {"masks": [clip.masks[0]], "boxes": [BOX]}
    without_object = parse_correction("2:20,16,40,32")
    assert (without_object.object, parse_correction("2@0:20,16,40,32").object) == (None, 0)
    with pytest.raises(
        InputError, match=r"which of the 2 objects it corrects; give one of object=0, object=1"
    ):
        record_objects(
            open_source(str(images)), settings(), tmp_path / "run", corrections=[without_object], **given
        )
    assert not (tmp_path / "run").exists()
    record_objects(open_source(str(images)), settings(), tmp_path / "run", **given)
    with pytest.raises(InputError) as refused:
        object_folders_of(tmp_path / "run", [without_object])
    assert "give one of 2@0 (object_0), 2@1 (object_1)" in refused.value.at_the_command_line
    [(folder, _)] = object_folders_of(tmp_path / "run", [Correction(2, box=BOX, object=1)]).items()
    assert folder.name == "object_1"


def test_a_single_object_needs_no_number():
    [corrections] = validate_corrections([Correction(2, box=BOX), Correction(3, box=BOX, object=0)])
    assert [one.object for one in corrections.values()] == [0, 0]


def test_a_source_of_its_own_kind_is_not_asked_for_more_than_the_protocol_has(clip):
    class Own:
        name, count, fps, intrinsics, intrinsics_origin, repeatable = "mine", 3, None, None, "", True

        def __iter__(self):
            yield from (Frame(index + 7, np.asarray(image)) for index, image in enumerate(clip.images))

    assert known_indices(Own()) is None
