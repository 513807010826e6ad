"""A camera measured by views of a board that were drawn through a known one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from seen_boards import HEIGHT, WIDTH, lens, view

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.geometry.calibration.calibrate import (
    Board,
    BoardView,
    calibrate,
    coverage,
    parse_squares,
    spread_views,
)
from tracking3d.geometry.lens import Lens

BOARD = Board(7, 5, square=30.0)


@pytest.fixture(scope="module")
def views() -> list[Frame]:
    return [view(BOARD, lens(), index) for index in range(12)]


def differs(found: Lens, true: Lens) -> float:
    """Pixels by which two lenses show the same directions apart, over the middle 80 % of the picture."""
    rows, columns = np.mgrid[0.1 * HEIGHT : 0.9 * HEIGHT : 20, 0.1 * WIDTH : 0.9 * WIDTH : 20]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    rays = (true.to_pinhole(pixels) - true.pinhole[2:]) / true.pinhole[:2]
    return float(np.abs(found.to_picture(rays * found.pinhole[:2] + found.pinhole[2:]) - pixels).max())


def test_the_camera_is_found(views):
    grey = Frame(12, np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    found = calibrate([*views, grey, SkippedFrame(13, "damaged")], BOARD)
    assert found.left_out == {12: "no board found", 13: "damaged"}
    assert found.error < 0.2 and found.coverage > 0.6 and found.camera.size == (WIDTH, HEIGHT)
    assert found.camera.intrinsics[0] == pytest.approx(420, abs=2) and 0 < found.focal_deviation < 2
    camera = found.camera
    again = Lens.of(camera.model, camera.coefficients, camera.intrinsics, WIDTH, HEIGHT)
    assert differs(again, lens()) < 1.5


def test_a_fisheye_is_found_too():
    true = lens("fisheye", (0.02, -0.01, 0.003, -0.001), focal=210.0)
    found = calibrate([view(BOARD, true, index) for index in range(12)], BOARD, "fisheye")
    assert found.error < 0.2
    assert found.camera.intrinsics[0] == pytest.approx(210, abs=2)


def test_a_view_that_is_off_is_left_out(views, monkeypatch):
    original = Board.find

    def disturbed(self, grey):
        numbers, pixels = original(self, grey)
        if grey[0, 0] == 7:
            pixels = pixels + np.random.default_rng(0).normal(0, 4, pixels.shape).astype(np.float32)
        return numbers, pixels

    marked = views[3].image.copy()
    marked[0, 0] = 7
    monkeypatch.setattr(Board, "find", disturbed)
    found = calibrate([*views[:3], replace(views[3], image=marked), *views[4:]], BOARD)
    assert "an outlier" in found.left_out[3] and 3 not in found.errors and found.error < 0.2


def test_too_few_views_are_refused(views):
    with pytest.raises(InputError, match="in 3 of 3 frames, but at least 6"):
        calibrate(views[:3], BOARD)


def test_another_board_is_refused(views):
    with pytest.raises(InputError, match="chessboard board of 9 x 6 squares in 0 of 2 frames"):
        calibrate(views[:2], Board(9, 6, "chessboard"))


def test_views_that_leave_much_of_the_picture_out_are_refused():
    far = [view(BOARD, lens(), 4 * index, near=False) for index in range(7)]
    with pytest.raises(InputError, match=r"of the image of the source, least in its .* part"):
        calibrate(far, BOARD)


def test_views_from_one_side_are_refused():
    flat = [view(BOARD, lens(), index, tilt=2.0) for index in range(8)]
    with pytest.raises(InputError, match="tilt the board"):
        calibrate(flat, BOARD)


def test_views_that_differ_are_taken():
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 50, (12, 2)).astype(np.float32)
    near = [BoardView(index, np.arange(12), corners + index % 2) for index in range(20)]
    away = [
        BoardView(20 + index, np.arange(12), corners + np.array([200 * index, 100])) for index in range(1, 3)
    ]
    kept = {one.index for one in spread_views([*near, *away], (640, 480), 4)}
    assert {21, 22} <= kept and len(kept) == 4
    assert coverage(away, (640, 480)) > coverage(away[:1], (640, 480))


@pytest.mark.parametrize("text", ["", "7", "7x", "x5", "7x5x3", "-7x5", "7.5x3", "axb"])
def test_what_are_no_squares(text):
    with pytest.raises(InputError, match="COLUMNSxROWS"):
        parse_squares(text)


@pytest.mark.parametrize(
    "bad", [(2, 5), (7, 99), (25, 25), (7, 5, "charuco", 0.0), (7, 5, "charuco", float("nan"))]
)
def test_a_board_that_cannot_be_is_refused(bad):
    with pytest.raises(InputError):
        Board(*bad)


def test_the_command_writes_what_run_reads(views, tmp_path, monkeypatch):
    from PIL import Image
    from typer.testing import CliRunner

    from tracking3d.cli import app
    from tracking3d.geometry.calibration.camera_files import read_camera

    monkeypatch.chdir(tmp_path)
    for one in views[:8]:
        Image.fromarray(one.image).save(f"{one.index:02d}.png")
    result = CliRunner().invoke(app, ["calibrate", "*.png", "--squares", "7x5", "--square-mm", "30"])
    assert result.exit_code == 0, result.output
    assert "8 views, reprojection error 0." in result.output and "% of the image covered" in result.output
    assert read_camera("camera.yaml").intrinsics[0] == pytest.approx(420, abs=4)
