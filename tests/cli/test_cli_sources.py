"""What can be said of the source, its lens and its masks on the command line, and what is refused there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tracking3d.cli.tracking import default_folder
from tracking3d.results.run_reader import RunReader

BOX = ("--box", "20,10,20,20")
CAMERA = """camera_matrix: [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]
distortion_coefficients: [-0.2, 0.05, 0, 0, 0]
image_width: 64
image_height: 48
"""


@pytest.fixture
def images(tmp_path) -> Path:
    (tmp_path / "shots").mkdir()
    for index in range(4):
        pixels = np.random.default_rng(index).integers(0, 256, (48, 64, 3)).astype(np.uint8)
        Image.fromarray(pixels).save(tmp_path / "shots" / f"{index:03d}.png")
    return tmp_path / "shots"


def test_images_are_as_fast_as_was_said(call, images, script):
    assert call("run", images, *BOX, "--fps", "20", "--out", "run").exit_code == 0
    run = RunReader(Path("run"))
    assert run.description["fps"] == 20
    assert [record.time for record in run.frames] == pytest.approx([0, 0.05, 0.1, 0.15])


def test_a_lens_reaches_the_run(call, images, script):
    options = ("--intrinsics", "60,60,31.5,23.5", "--distortion=-0.2,0.05,0,0")
    assert call("run", images, *BOX, *options, "--out", "run").exit_code == 0
    run = RunReader(Path("run"))
    lens = run.camera.lens
    assert (
        lens is not None and lens.coefficients == (-0.2, 0.05, 0, 0) and lens.picture == (60, 60, 31.5, 23.5)
    )
    assert run.camera.fx == lens.pinhole[0] < 60
    assert run.pinhole_mask(0).shape == run.mask(0).shape
    assert script.built[0][0].camera.distortion == (-0.2, 0.05, 0, 0)


@pytest.mark.parametrize("option", ["--camera", "--intrinsics"])
def test_a_camera_file_reaches_the_run(call, images, script, option):
    Path("camera.yaml").write_text(CAMERA)
    assert call("run", images, *BOX, option, "camera.yaml", "--out", "run").exit_code == 0
    assert RunReader(Path("run")).camera.origin == "camera.yaml, without the distortion of its lens (radtan)"


def test_a_damaged_lens_in_a_run_is_told(call, images, script):
    call("run", images, *BOX, "--intrinsics", "60,60,31.5,23.5", "--distortion=-0.2,0.05,0,0", "--out", "run")
    file = Path("run/run.json")
    about = json.loads(file.read_text())
    about["camera"]["lens"]["coefficients"] = ["x"]
    file.write_text(json.dumps(about))
    refused = call("points", "run", "--xy", "25,15", "--by-mesh")
    assert refused.exit_code == 2 and "names no camera (coefficients of the lens" in refused.output


def test_every_object_of_an_indexed_mask_is_tracked(call, images, script):
    labels = np.zeros((48, 64), np.uint8)
    labels[5:15, 5:20], labels[20:40, 30:50] = 1, 2
    image = Image.fromarray(labels)
    image.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0] + 253 * [0, 0, 0])
    image.save("first.png")
    assert call("run", images, "--mask", "first.png@all", "--out", "runs").exit_code == 0
    assert [prompt.mask.sum() for _, prompt in script.built] == [150, 400]
    assert call("run", images, "--mask", "first.png@2", "--out", "run").exit_code == 0
    assert script.built[-1][1].box == (30, 20, 20, 20)


def test_a_box_comes_from_a_file_of_regions(call, images, script):
    Path("groundtruth.txt").write_text("1,2,10,11\n3,4,12,13\n5,6,20,6,20,16,5,16\n")
    assert call("run", images, "--box", "groundtruth.txt", "--frames", "1:", "--out", "run").exit_code == 0
    assert script.built[0][1].box == (3, 4, 12, 13)
    refused = call("run", images, "--box", "groundtruth.txt", "--frames", "3:", "--out", "other")
    assert refused.exit_code == 2 and "has no box in line 4" in refused.output


REFUSED = {
    "--fps 0": "not a frame rate",
    "--fps nan": "not a frame rate",
    "--distortion 0.1,0.2": None,
    "--distortion=1,2,3,4,5,6,7,8,9,10,11,12,13,14,15": "has 15 numbers",
    "--distortion=a,b": "K1,K2,P1,P2",
    "--distortion=0.1,nan,0,0 --fov 40": "K1,K2,P1,P2",
    "--distortion=wide:1,2,3,4": "use radtan or fisheye",
    "--distortion=fisheye:1,2,3,4,5 --fov 40": "has 5 numbers",
    "--distortion=-0.1,0,0,0": "needs the focal lengths",
    "--distortion=-9,0,0,0 --fov 60": "folds pictures",
    "--camera none.yaml": "does not exist",
    "--camera camera.yaml --fov 40": "leave out --fov",
    "--camera camera.yaml --intrinsics camera.yaml": "not both",
    "--camera wide.yaml": "another aspect ratio",
    "--camera camera.yaml:left": "does not exist|has no camera left",
    "--mask first.png@3": "does not exist",
    "--masks none.json": "--masks none.json does not exist",
    "--masks camera.yaml": "cannot be read as masks",
}


@pytest.mark.parametrize("options", REFUSED)
def test_what_cannot_be_is_refused_in_a_sentence(call, images, script, options):
    Path("camera.yaml").write_text(CAMERA)
    Path("wide.yaml").write_text(CAMERA.replace("image_height: 48", "image_height: 30"))
    given = () if options.startswith("--mask") else BOX
    result = call("run", images, *given, *options.split(), "--out", "run")
    if REFUSED[options] is None:  # two coefficients are filled up, and nobody gave the focal length
        assert "needs the focal lengths" in result.output
    else:
        assert any(one in " ".join(result.output.split()) for one in REFUSED[options].split("|")), (
            result.output
        )
    assert result.exit_code == 2 and not Path("run").exists()
    assert "Traceback" not in result.output


@pytest.mark.parametrize("source", ["file:/etc/passwd", "concat:a|b", "http://", "rtsp://127.0.0.1:1/x"])
def test_addresses_that_are_refused(call, script, source):
    result = call("run", source, *BOX)
    assert result.exit_code == 2 and result.output.startswith("error: ") and result.output.count("\n") == 1


def test_runs_of_addresses_are_called_after_their_end():
    assert default_folder("https://user:pw@host:8/videos/my%20clip.mp4?x=1") == Path("runs/my_20clip")
    assert default_folder("rtsp://camera.local/") == Path("runs/camera")
    assert default_folder("http://[") == Path("runs/stream")


def test_a_board_is_printed_at_its_true_size(call):
    assert (
        call("calibrate", "board", "--out", "board.png", "--squares", "4x5", "--square-mm", "25.4").exit_code
        == 0
    )
    with Image.open("board.png") as image:
        across = image.width / image.info["dpi"][0]
        assert across == pytest.approx(4.4, abs=0.01)  # four squares of an inch, and the margins
        assert image.convert("L").getextrema() == (0, 255)
    assert call("calibrate", "board", "--out", "board.pdf").exit_code == 0
    assert Path("board.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("shots", "--squares", "7"), "COLUMNSxROWS"),
        (("shots", "--squares", "2x2"), "3 to 25"),
        (("shots", "--board", "dots"), "charuco or chessboard"),
        (("shots", "--model", "omni"), "radtan or fisheye"),
        (("shots", "--square-mm", "-1"), "above 0"),
        (("shots", "--out", "no/where.yaml"), "does not exist; make it first"),
        (("shots", "--out", "there.yaml"), "already exists"),
        (("shots",), "in 0 of 4 frames"),
        (("nowhere.mp4",), "does not exist"),
        (("board", "--out", "board.doc"), "neither a .png nor a .pdf"),
        (("board", "--out", "no/board.png"), "cannot be written"),
        (("board", "--out", "b.png", "--squares", "25x25"), "more than the available 250 markers"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(call, images, arguments, told):
    Path("there.yaml").write_text("")
    result = call("calibrate", *arguments)
    assert result.exit_code == 2 and told in " ".join(result.output.split()), result.output
