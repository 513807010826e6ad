"""A run is corrected from the viewer: by a process that is given a frame and numbers, and that loses nothing."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import numpy as np
import pytest
from browser import open_page
from recorded_runs import HEIGHT, WIDTH, frame_of, write_run

pytest.importorskip("viser", reason="viser is absent: pip install 'tracking3d[view]'")

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.results import layout
from tracking3d.ui.picker.correction import DrawnCorrection
from tracking3d.ui.viewer import correcting
from tracking3d.ui.viewer.correcting import Corrections, RunCorrection
from tracking3d.ui.viewer.followed_run import FollowedRun
from tracking3d.ui.viewer.opening import open_viewer
from tracking3d.ui.viewer.run_images import LatestImages
from tracking3d.ui.web.access import Access
from tracking3d.video import open_source


class Frames:
    def image(self, index):
        return frame_of(index).image


@pytest.fixture
def described(run):
    """A run as one that was recorded describes itself."""
    path = run / layout.RUN
    told = json.loads(path.read_text())
    told["config"] = load_config().model_dump(mode="json")
    told["prompt"] = {"first_frame": 0, "box": [30, 20, 36, 24], "mask": None, "points": None}
    path.write_text(json.dumps(told))
    return run


@pytest.fixture
def commands(monkeypatch):
    """What would be started; a stand-in for it ends as it is told."""
    started = []
    popen = subprocess.Popen

    def start(command, **options):
        started.append(command)
        script = "import sys; print('error: no luck; try again.', file=sys.stderr); sys.exit(2)"
        if "7:" in command[5]:
            script = ""
        if "9:" in command[5]:
            script = "import time; time.sleep(60)"
        return popen([sys.executable, "-c", script], **options)

    monkeypatch.setattr(correcting, "Popen", start)
    return started


@pytest.fixture
def correction(described):
    run = FollowedRun(described, "run")
    run.look_again()
    correction = RunCorrection(run, Frames(), None, Access())
    yield correction
    correction.close()


def wait(correction):
    while (now := correction.progress()).running:
        time.sleep(0.02)
    return now


def test_the_process_is_our_own_with_the_folder_that_is_shown(correction, commands, described):
    correction.begin(DrawnCorrection(7, box=(30.25, 20.0, 36.0, 24.0)))
    [command] = commands
    assert command == [
        sys.executable, "-m", "tracking3d", "correct", str(described), "7:30.25,20,36,24", "--quiet"
    ]  # fmt: skip
    assert wait(correction).sentence == "Frame 7 is corrected."


def test_a_mask_goes_by_a_file_in_the_run_folder(correction, commands, described):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20:40, 30:60] = True
    correction.begin(DrawnCorrection(7, mask=mask))
    assert commands[0][5] == f"7:{described / layout.DRAWN}"
    wait(correction)
    assert not (described / layout.DRAWN).exists()


def test_why_it_failed_is_told_and_another_may_be_tried(correction, commands):
    correction.begin(DrawnCorrection(4, box=(1, 1, 5, 5)))
    now = wait(correction)
    assert now.failed
    assert now.sentence == "The correction failed and the run is unchanged: no luck; try again."
    correction.begin(DrawnCorrection(7, box=(1, 1, 5, 5)))
    assert not wait(correction).failed


def test_one_at_a_time_and_it_ends_with_the_viewer(correction, commands, described):
    correction.begin(DrawnCorrection(9, box=(1, 1, 5, 5)))
    process = correction._process
    with pytest.raises(InputError, match="A correction is in progress"):
        correction.begin(DrawnCorrection(7, box=(1, 1, 5, 5)))
    stage = described / layout.CORRECTING
    stage.mkdir()
    (stage / layout.FRAMES).write_bytes((described / layout.FRAMES).read_bytes()[:-5])
    now = correction.progress()
    assert (now.running, now.sentence) == (True, "Correcting frame 9: 11 of 12 frames estimated.")
    correction.close()
    assert process.poll() is not None


@pytest.mark.parametrize(
    ("frame", "why"), [(0, "The object was given in frame 0"), (12, "no estimate for frame 12")]
)
def test_frames_that_cannot_be_corrected_are_refused(correction, commands, frame, why):
    with pytest.raises(InputError, match=why):
        correction.begin(DrawnCorrection(frame, box=(1, 1, 5, 5)))
    assert commands == []


def test_a_link_is_offered_for_frames_that_can_be_corrected_only(correction):
    corrections = Corrections([correction], Access())
    assert "Correct frame 7" in corrections.offer(7)
    for frame, why in [(0, "The object was given in frame 0"), (12, "no estimate for frame 12")]:
        offered = corrections.offer(frame)
        assert why in offered
        assert "href" not in offered


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"prompt": None}, "names no prompt"),
        ({"config": {"tracker": {"name": "precomputed"}}}, "masks of the run are precomputed"),
    ],
)
def test_runs_that_cannot_be_corrected_say_why(described, change, why):
    path = described / layout.RUN
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    one = RunCorrection(FollowedRun(described, "run"), Frames(), None, Access())
    assert why in one.why_not


def test_a_run_whose_frames_are_gone_says_so(described):
    run = FollowedRun(described, "run")
    assert "--source" in RunCorrection(run, None, None, Access()).why_not
    passed = LatestImages(open_source(iter([frame_of(0).image])))
    assert "from a camera" in RunCorrection(run, passed, None, Access()).why_not


def test_the_viewer_of_a_run_whose_relative_video_has_moved_names_the_option_that_gives_it(described, caplog):
    path = described / layout.RUN
    path.write_text(json.dumps(json.loads(path.read_text()) | {"source": "clips/gone.mp4"}))
    open_viewer([described], Access(), port=0).close()
    assert f"The video of the run {described} was not found; give its path as --source." in caplog.messages


@pytest.mark.slow
def test_a_person_draws_a_box_and_the_viewer_shows_how_it_goes(described, commands, tmp_path):
    write_run(tmp_path / "other", 12)
    viewer = open_viewer([described], Access(), port=0)
    try:
        with open_page(viewer.address, 1360, 760) as page:
            page.wait_for_selector(".timeline svg")
            page.evaluate("document.querySelector('.mantine-Notifications-root').style.display = 'none'")
            viewer.go_to(7)
            page.wait_for_selector(".told[data-frame='7']")
            page.click("[role=tab]:has-text('Correct')")
            with page.context.expect_page() as opened:
                page.click("a.correct:has-text('frame 7')")
            drawing = opened.value
            drawing.wait_for_selector("h1:has-text('Mark the object in this frame')")
            assert drawing.input_value("#number") == "7"
            area = drawing.locator("#canvas").bounding_box()
            drawing.mouse.move(area["x"] + area["width"] * 0.3, area["y"] + area["height"] * 0.3)
            drawing.mouse.down()
            drawing.mouse.move(area["x"] + area["width"] * 0.7, area["y"] + area["height"] * 0.7, steps=3)
            drawing.mouse.up()
            drawing.wait_for_selector("#status:has-text('The run continues from this mask')")
            drawing.click("#start")
            drawing.wait_for_selector("#status:has-text('Frame 7 is corrected.')")
            page.wait_for_selector("text=Frame 7 is corrected.")
    finally:
        viewer.close()
    assert commands[0][5].startswith("7:")
