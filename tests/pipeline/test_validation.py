"""Wrong arguments are refused when the library is called, in a sentence that names them as the library does."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from tracking3d import Frame, PipelineConfig, Prompt, Session, load_config, track, track_objects
from tracking3d.errors import InputError, OutputError, argument
from tracking3d.pipeline.record import record, record_objects
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video import LatestFrames, open_source

IMAGE = np.zeros((48, 64, 3), np.uint8)
BOX = (10, 8, 20, 20)
MASK = np.pad(np.ones((20, 20), bool), ((8, 20), (10, 34)))


@pytest.fixture(scope="module")
def config() -> PipelineConfig:
    return load_config(overrides=["crop.size=32"])


WRONG_FRAMES = {
    "a path that is not there": (Path("clip.mp4"), r"^clip.mp4 does not exist; give a video file"),
    "a text that is no path": ("clip.mp4", r"^clip.mp4 does not exist; give a video file"),
    "bytes": (b"clip.mp4", r"^frames= is a bytes; give .*uint8"),
    "none": (None, r"^frames= is None; give .*uint8"),
    "a number": (3, r"^frames= is an int; "),
    "a capture": (cv2.VideoCapture(), r"^frames= is a VideoCapture that is not open; open it"),
    "one image": (IMAGE, r"^frames= is an array of shape \(48, 64, 3\) and type uint8; .*\(N, H, W, 3\)"),
    "floats": (np.zeros((2, 48, 64, 3)), r"^frames= is an array of shape \(2, 48, 64, 3\) and type float64"),
    "grey": (np.zeros((2, 48, 64), np.uint8), r"^frames= is an array of shape \(2, 48, 64\)"),
    "a tensor of one image": (torch.zeros(3, 48, 64), r"^frames= is a Tensor of shape \(3, 48, 64\); .*\(N, 3, H, W\)"),
    "a tensor to 255": (torch.full((2, 3, 48, 64), 255.0), r"^Frame 0 is a Tensor of floats from 255 to 255; "),
    "a tensor of nan": (torch.full((2, 3, 48, 64), math.nan), r"^Frame 0 is a Tensor of floats from nan to nan"),
    "a tensor of int": (torch.zeros(2, 3, 48, 64, dtype=torch.int32), r"^Frame 0 is a Tensor of type torch.int32"),
    "a dictionary": ({"a": IMAGE}, r"^frames= is a dict; "),
    "a class": (list, r"^frames= is the class list; "),
    "grey images": ([IMAGE[..., 0]], r"^Frame 0 has shape \(48, 64\) and type uint8; give .*uint8, RGB"),
    "float images": ([IMAGE / 255], r"^Frame 0 has shape \(48, 64, 3\) and type float64; "),
    "nothings": ([None], r"^Frame 0 is None; "),
    "paths that are not there": (["frame.png"], r"^frame.png cannot be read as an image \(No such file"),
    "ragged lists": ([[[1], [1, 2]]], r"^Frame 0 is a list; "),
}  # fmt: skip

WRONG_BOXES = {
    "text": ("10,8,20,20", r"^box='10,8,20,20' is not four numbers"),
    "texts": (("10", "8", "20", "20"), r"^box=.* is not four numbers"),
    "three": ((1, 2, 3), r"^box=\(1, 2, 3\) is not four numbers"),
    "a number": (5, r"^box=5 is not four numbers"),
    "a dictionary": (dict(zip("xywh", BOX, strict=True)), r"^box=.* is not four numbers"),
    "complex": ((1j, 2, 3, 4), r"^box=.* is not four numbers"),
    "beyond floats": ((10**400, 0, 5, 5), r"^box=.* is not four numbers"),
    "nan": ((math.nan, 0, 5, 5), r"^box=nan,0,5,5 has a value that is not a finite number"),
    "no size": ((5, 5, 0, 5), r"^box=5,5,0,5 has no size"),
}

WRONG_MASKS = {
    "text": ("mask.png", r"^mask='mask.png' is text; give .*pathlib.Path"),
    "no values": (np.zeros((0, 0), bool), r"^mask= is an array of shape \(0, 0\)"),
    "three axes": (IMAGE, r"^mask= is an array of shape \(48, 64, 3\) and type uint8; give an \(H, W\)"),
    "objects": (np.full((48, 64), None), r"^mask= is .*type object"),
    "a number": (7, r"^mask= is an int of shape \(\)"),
    "ragged lists": ([[1], [1, 2]], r"^mask= is a list that NumPy cannot convert"),
    "nan": (np.full((48, 64), np.nan), r"^mask= has values that are not finite"),
    "empty": (np.zeros((48, 64), bool), r"^mask= is empty; mark the object in it"),
}

WRONG_CONFIGS = {
    "a dictionary": ({"crop": {"size": 32}}, r"^config= is a dict; give a PipelineConfig"),
    "a number": (5, r"^config= is an int; "),
    "a class": (PipelineConfig, r"^config= is the class PipelineConfig; "),
    "no file": ("nowhere.yaml", r"nowhere\.yaml does not exist"),
}


def cases(table):
    return pytest.mark.parametrize(("wrong", "sentence"), table.values(), ids=table)


@cases(WRONG_FRAMES)
def test_frames_of_the_wrong_kind_are_refused_when_track_is_called(config, wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        track(wrong, box=BOX, config=config)
    with pytest.raises(InputError, match=sentence):
        track_objects(wrong, boxes=[BOX], config=config)


def test_frames_that_numpy_reads_as_images_are_taken_whatever_they_are(config):
    for frames in (
        torch.zeros(1, 48, 64, 3, dtype=torch.uint8),
        [Image.fromarray(IMAGE)],
        np.ma.masked_array(IMAGE[None]),
    ):
        [estimate] = track(frames, mask=MASK, config=config)
        assert estimate.mask.shape == (48, 64)


@cases(WRONG_BOXES)
def test_a_wrong_box_is_refused_when_track_is_called(config, wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        track([IMAGE], box=wrong, config=config)
    with pytest.raises(InputError, match=sentence.replace("^box", r"^boxes\[1\]")):
        track_objects([IMAGE], boxes=[BOX, wrong], config=config)


@cases(WRONG_MASKS)
def test_a_wrong_mask_is_refused_when_track_is_called(config, wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        track([IMAGE], mask=wrong, config=config)
    with pytest.raises(InputError, match=sentence.replace("^mask", r"^masks\[0\]")):
        track_objects([IMAGE], boxes=[BOX], masks=[wrong], config=config)


@cases(WRONG_CONFIGS)
def test_a_wrong_configuration_is_refused_when_track_is_called(wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        track([IMAGE], box=BOX, config=wrong)
    with pytest.raises(InputError, match=sentence):
        track_objects([IMAGE], boxes=[BOX], config=wrong)


@pytest.mark.parametrize("prompt", [{}, {"box": BOX, "mask": MASK}], ids=["neither", "both"])
def test_either_a_box_or_a_mask_is_asked_for_by_their_names(config, prompt):
    with pytest.raises(InputError, match=r"one of a box, a mask or points .*: box=, mask= or points=\.$"):
        track([IMAGE], config=config, **prompt)


def test_objects_are_asked_for_by_lists(config):
    for boxes in (None, "box", 5):
        with pytest.raises(InputError, match=r"^boxes=.*; give a list with one item per object"):
            track_objects([IMAGE], boxes=boxes, config=config)
    with pytest.raises(InputError, match=r"boxes, masks or points .*: boxes=, masks= or points=\.$"):
        track_objects([IMAGE], config=config)


def test_what_only_the_first_frame_can_tell_is_told_by_its_argument(config):
    outside = track([IMAGE], box=(500, 500, 5, 5), config=config)
    with pytest.raises(InputError, match=r"^box=500,500,5,5 lies outside frame 0, which is 64 x 48 pixels"):
        next(outside)
    with pytest.raises(InputError, match=r"^mask= is 64 x 20 pixels, but frame 0 is 64 x 48"):
        next(track([IMAGE], mask=MASK[:20], config=config))


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"source": "clip.mp4"}, r"^source= is text; open it with .*open_source"),
        ({"source": [IMAGE]}, r"^source= is a list; open it with .*open_source"),
        ({"config": {}}, r"^config= is a dict; "),
        ({"folder": None}, r"^folder= is None; "),
        ({"box": (1, 2)}, r"^box=\(1, 2\) is not four numbers"),
        ({"box": None}, r": box=, mask= or points=\.$"),
        ({"box": None, "mask": "mask.png"}, r"^mask='mask.png' is text"),
        ({"box": None, "mask": Path("nowhere.png")}, r"^mask=nowhere.png does not exist"),
        ({"box": (500, 500, 5, 5)}, r"^box=500,500,5,5 lies outside"),
    ],
)
def test_record_refuses_wrong_arguments_and_leaves_no_folder(config, tmp_path, changed, sentence):
    given = {
        "source": open_source([IMAGE]),
        "config": config,
        "folder": tmp_path / "run",
        "box": BOX,
        **changed,
    }
    with pytest.raises(InputError, match=sentence):
        record(given.pop("source"), given.pop("config"), given.pop("folder"), **given)
    assert not (tmp_path / "run").exists()


def test_record_objects_names_the_object_s_box(config, tmp_path):
    with pytest.raises(InputError, match=r"^boxes\[1\]=5,5,-1,5 has no size"):
        record_objects(open_source([IMAGE]), config, tmp_path / "run", boxes=[BOX, (5, 5, -1, 5)])


def test_record_names_its_own_arguments_where_a_folder_is_taken(config, tmp_path):
    record(open_source([IMAGE]), config, str(tmp_path), mask=MASK)
    with pytest.raises(
        OutputError, match=r"already holds a run; choose another folder or pass overwrite=True\.$"
    ):
        record(open_source([IMAGE]), config, tmp_path, mask=MASK)


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"config": None}, r"^config= is None; "),
        ({"prompt": BOX}, r"^prompt= is a tuple; make one .*make_prompt"),
        ({"prompt": Prompt((1, 2))}, r"^prompt\.box=\(1, 2\) is not four numbers"),
        ({"prompt": Prompt(BOX, "mask.png")}, r"^prompt\.mask='mask.png' is text"),
        ({"prompt": None}, r"either a box or a mask"),
        ({"intrinsics": (1, 2)}, r"^intrinsics=\(1, 2\) must be fx, fy, cx, cy"),
        ({"intrinsics": (0, 50, 32, 24)}, r"^intrinsics=.* positive fx and fy"),
        ({"intrinsics": (math.nan, 50, 32, 24)}, r"^intrinsics=.* must be fx"),
    ],
)
def test_a_session_refuses_wrong_arguments(config, changed, sentence):
    given = {"config": config, "prompt": Prompt(BOX), "intrinsics": None, **changed}
    with pytest.raises(InputError, match=sentence):
        Session(**given)


@pytest.mark.parametrize(
    ("frame", "sentence"),
    [
        (IMAGE, r"^frame= is an array; wrap the image: Frame\(index, image\)"),
        (None, r"^frame= is None; "),
        (Frame(3, IMAGE / 255), r"^Frame 3 has shape \(48, 64, 3\) and type float64; "),
        (Frame(3, None), r"^Frame 3 is None; "),
        (Frame(0, IMAGE[:10]), r"^prompt\.mask= has shape \(48, 64\), but frame 0 has \(10, 64\)"),
    ],
)
def test_a_session_takes_frames_only(config, frame, sentence):
    session = Session(config, make_prompt(Frame(0, IMAGE), mask=MASK))
    with pytest.raises(InputError, match=sentence):
        session.step(frame)


def test_a_selection_and_a_rate_of_the_wrong_type_are_refused():
    with pytest.raises(InputError, match=r"^frames=slice\(0, 2, None\) is not a text START:STOP:STEP"):
        open_source([IMAGE], slice(0, 2))
    with pytest.raises(InputError, match=r"^frames='x' is not START:STOP:STEP"):
        open_source([IMAGE], "x")
    with pytest.raises(InputError, match=r"played at '15' frames per second; give a positive rate"):
        LatestFrames(open_source([IMAGE]), rate="15")


def test_an_error_names_an_argument_for_whom_it_is_told():
    error = InputError(f"{argument('box=', '--box ')}1,2 is wrong; see {argument('folder', '--out')}.")
    assert str(error) == "box=1,2 is wrong; see folder."
    assert error.at_the_command_line == "--box 1,2 is wrong; see --out."
    assert str(InputError("nothing is named")) == InputError("nothing is named").at_the_command_line
