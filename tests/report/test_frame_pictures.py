"""The frames of a page keep to its budget, and to the frames that they show."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from turning_sphere import turning_sphere_of, written_run

from tracking3d.results.run_reader import RunReader
from tracking3d.ui.report.frame_pictures import BUDGET, NARROWEST, frame_pictures


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """Thirty frames that hardly compress."""
    clip, rng = turning_sphere_of(30, 96, 72), np.random.default_rng(0)
    for frame in clip.frames:
        frame.image[:] = rng.integers(0, 255, frame.image.shape)
    folder = tmp_path_factory.mktemp("noisy") / "run"
    written_run(folder, clip)
    return RunReader(folder)


def test_a_short_run_shows_every_frame_as_large_as_its_overlay(written):
    pictures = frame_pictures(RunReader(written))
    assert pictures.positions == tuple(range(12))
    assert (pictures.width, pictures.height) == (320, 240)
    image = cv2.imdecode(np.frombuffer(pictures.jpegs[0], np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (240, 320, 3)


@pytest.mark.parametrize("budget", [BUDGET, 600_000, 100_000, 20_000])
def test_pictures_keep_to_their_budget(noisy, budget):
    pictures = frame_pictures(noisy, budget)
    assert 0 < sum(map(len, pictures.jpegs)) <= budget
    assert len(pictures.jpegs) == len(pictures.positions)
    assert pictures.positions[0] == 0
    assert len(set(np.diff(pictures.positions))) == 1
    assert pictures.step == pictures.positions[1]
    assert NARROWEST // 2 <= pictures.width <= NARROWEST


@pytest.mark.parametrize("damage", ["absent", "cut off", "nonsense"])
def test_an_overlay_that_is_not_whole_gives_as_many_pictures_as_it_has(run_folder, damage):
    video = run_folder / "overlay.mp4"
    data = video.read_bytes()
    video.unlink()
    if damage == "cut off":
        video.write_bytes(data[: len(data) // 2])
    elif damage == "nonsense":
        video.write_bytes(b"no video" * 100)
    pictures = frame_pictures(RunReader(run_folder))
    assert len(pictures.jpegs) == len(pictures.positions)
    assert (0 < len(pictures.jpegs) < 12) == (damage == "cut off")
