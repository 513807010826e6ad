"""A box is refused if it is likely not what was meant, and can be written in two ways wherever it is read as text."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tracking3d.batch.listing import list_jobs
from tracking3d.batch.one_video import track_video
from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.frames import Frame
from tracking3d.trackers.prompts.boxes import parse_box
from tracking3d.trackers.prompts.corrections import Correction, parse_correction
from tracking3d.trackers.prompts.prompt import PromptSet, make_prompt
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.vot.regions import prompt_of

VGA = Frame(0, np.zeros((360, 640, 3), np.uint8), name="000.png")


def refusal(box: tuple[float, float, float, float], **more) -> str:
    with pytest.raises(InputError) as caught:
        make_prompt(VGA, box, **more)
    return caught.value.at_the_command_line


def test_corners_given_as_a_size_are_refused_with_the_likely_meaning():
    assert refusal((301, 11, 597, 238)) == (
        "--box 301,11,597,238 reaches beyond the frame (301+597 > 640); "
        "did you mean X,Y,WIDTH,HEIGHT = 301,11,296,227?"
    )


@pytest.mark.parametrize(
    ("box", "beyond"),
    [
        ((500, 100, 300, 50), "500+300 > 640"),
        ((-40, 100, 300, 50), "-40 < 0"),
        ((10, 10, 700, 400), "10+700 > 640, 10+400 > 360"),
        ((500, 300, 520, 310), "500+520 > 640, 300+310 > 360"),
    ],
)
def test_a_box_with_no_likely_meaning_is_refused_without_a_guess(box, beyond):
    sentence = refusal(box)
    assert f"reaches beyond the frame ({beyond}); " in sentence
    if box == (500, 300, 520, 310):
        assert sentence.endswith("did you mean X,Y,WIDTH,HEIGHT = 500,300,20,10?")
    else:
        assert sentence.endswith("give the part inside 000.png, which is 640 x 360 pixels.")


def test_a_few_pixels_beyond_the_frame_are_cut_off_with_a_note(caplog):
    with caplog.at_level(logging.WARNING):
        assert make_prompt(VGA, (-4, 350, 656, 14)).box == (0, 350, 640, 10)
    assert "The box -4,350,656,14 extends beyond the frame" in caplog.text


def test_a_correction_far_beyond_the_frame_is_refused_before_anything_is_tracked():
    with pytest.raises(InputError, match=r"--correct |corrections=") as caught:
        Correction(40, box=(301, 11, 597, 238)).check_fits((360, 640))
    assert "did you mean X,Y,WIDTH,HEIGHT = 301,11,296,227?" in str(caught.value)


def test_corners_are_read_as_corners():
    assert parse_box("301,11,597,238", box_format="xyxy") == (301, 11, 296, 227)
    correction = parse_correction("40@1:301,11,597,238", "xyxy")
    assert (correction.box, correction.object) == ((301, 11, 296, 227), 1)


@pytest.mark.parametrize("text", ["301,11,301,238", "301,11,296,227", "301,238,597,11"])
def test_corners_of_no_size_are_refused(text):
    with pytest.raises(InputError, match=r"has no size: as X1,Y1,X2,Y2, X2 must be more than X1"):
        parse_box(text, box_format="xyxy")


def test_messages_write_a_box_as_the_user_did():
    assert refusal((400, 10, 500, 390), box_format="xyxy") == (
        "--box 400,10,900,400 reaches beyond the frame (900 > 640, 400 > 360); "
        "give the part inside 000.png, which is 640 x 360 pixels."
    )
    with pytest.raises(InputError, match=r"boxes\[0\]=400,10,900,400 reaches"):
        PromptSet([(400, 10, 500, 390)], as_lists=True, box_format="xyxy").make(VGA, "csrt")


def test_box_of_a_dataset_or_a_toolkit_may_reach_beyond_the_frame(tmp_path):
    Image.fromarray(VGA.image).save(tmp_path / "000.png")
    truth = Truth("clip", (tmp_path / "000.png",), box=(-100, 20, 300, 200))
    assert truth.box_in_frame() == (0, 20, 200, 200)
    assert replace(truth, box=None).box_in_frame() is None
    assert prompt_of((-100, 20, 300, 200), VGA).box == (0, 20, 200, 200)


def test_run_reads_both_formats(script, clip, call):
    for box, more in (("20,10,20,20", ()), ("20,10,40,30", ("--box-format", "xyxy"))):
        assert call("run", clip, "--box", box, *more, "--out", "out", "--overwrite").exit_code == 0
        assert script.built[-1][1].box == (20, 10, 20, 20)


def test_run_refuses_corners_given_as_a_size(script, clip, refused):
    line = refused("run", clip, "--box", "30,10,50,30", "--out", "out", "--quiet")
    assert line == (
        "error: --box 30,10,50,30 reaches beyond the frame (30+50 > 64); did you mean X,Y,WIDTH,HEIGHT = 30,10,20,20?"
    )
    assert not Path("out").exists()


def test_an_unknown_format_is_refused(script, clip, refused):
    line = refused("run", clip, "--box", "1,2,3,4", "--box-format", "xywy")
    assert line == (
        "error: --box-format 'xywy' is not a format of boxes; give xywh (X,Y,WIDTH,HEIGHT) or xyxy (X1,Y1,X2,Y2)."
    )


def test_a_configuration_file_says_how_its_boxes_are_written(script, clip, call):
    Path("run.yaml").write_text('prompt: {box: "20,10,40,30", box_format: xyxy}\n')
    assert call("run", clip, "--config", "run.yaml", "--out", "out").exit_code == 0
    assert script.built[-1][1].box == (20, 10, 20, 20)


def test_correct_reads_both_formats(script, clip, call):
    assert call("run", clip, "--box", "20,10,20,20", "--out", "out").exit_code == 0
    assert call("correct", "out", "3:20,10,40,30", "--box-format", "xyxy").exit_code == 0
    [correction] = json.loads(Path("out/run.json").read_text())["prompt"]["corrections"]
    assert correction["box"] == [20, 10, 20, 20]


def test_a_batch_takes_the_format_from_the_row_or_the_option(tmp_path):
    table = tmp_path / "videos.csv"
    table.write_text('video,box,box_format\na.mp4,"1,2,3,4",xyxy\nb.mp4,"1,2,3,4",\n')
    config = load_config()
    formats = [job.box_format for job in list_jobs(str(table), lambda row: config)]
    assert formats == ["xyxy", "xywh"]
    formats = [job.box_format for job in list_jobs(str(table), lambda row: config, box_format="xyxy")]
    assert formats == ["xyxy", "xyxy"]


def test_a_batch_tracks_a_box_given_by_its_corners(script, clip, tmp_path):
    table = tmp_path / "videos.csv"
    table.write_text(f'video,box,box_format\n{clip},"20,10,40,30",xyxy\n')
    [job] = list_jobs(str(table), lambda row: load_config())
    track_video(lambda content: None, job, str(tmp_path / "runs"), "", report=False)
    [run] = (tmp_path / "runs").glob("*/run.json")
    assert json.loads(run.read_text())["prompt"]["box"] == [20, 10, 20, 20]
