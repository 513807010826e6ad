"""``tracking3d view`` and ``pick``, and ``run`` with the browser: what they hand on, and what they say without it."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from tracking3d.cli import pick as pick_module
from tracking3d.cli import run as run_module
from tracking3d.cli import view as view_module
from tracking3d.picker.drawing import DrawnObject
from tracking3d.picker.session import Picked
from tracking3d.results.run_reader import RunReader
from tracking3d.viewer import opening

BOX = ("--box", "20,10,20,20")
CUP = DrawnObject(name="cup", colour="#00a5e0", frame=2, box=(20, 10, 20, 20))


class OpenedViewer:
    """Stands in for the viewer."""

    address = "http://127.0.0.1:8080/"

    def __init__(self, folders, access, port=8080, source=None, images=None):
        self.folders, self.access, self.port, self.source, self.images = folders, access, port, source, images
        self.closed = False
        self.seen = [(path / "run.json").is_file() for path in folders]

    def close(self):
        self.closed = True


@pytest.fixture
def viewers(monkeypatch) -> list[OpenedViewer]:
    opened: list[OpenedViewer] = []

    def open_viewer(*arguments, **more):
        opened.append(OpenedViewer(*arguments, **more))
        return opened[-1]

    monkeypatch.setattr(opening, "check_viser", lambda what: None)
    monkeypatch.setattr(opening, "open_viewer", open_viewer)
    monkeypatch.setattr(view_module, "wait_for_the_end", lambda: None)
    return opened


@pytest.fixture
def no_viser(monkeypatch):
    monkeypatch.setattr(opening, "find_spec", lambda name: None)


def test_without_the_extra_view_names_what_to_install(refused, no_viser, tmp_path):
    assert refused("view", tmp_path) == (
        "error: `tracking3d view` needs viser; install it with: pip install 'tracking3d[view]'."
    )


def test_without_the_extra_run_view_says_so_before_anything_begins(refused, no_viser, clip, script):
    assert "--view needs viser" in refused("run", clip, *BOX, "--view", "--out", "run")
    assert script.built == [] and not Path("run").exists()


def test_view_hands_on_what_it_was_given_and_prints_the_address(call, viewers, tmp_path):
    result = call("view", "a", "b", "--source", "clip.mp4", "--port", "0", "--host", "0.0.0.0")
    assert result.exit_code == 0 and result.stderr == "http://127.0.0.1:8080/\n"
    [viewer] = viewers
    assert (viewer.folders, viewer.source, viewer.port) == ([Path("a"), Path("b")], "clip.mp4", 0)
    assert viewer.access.host == "0.0.0.0" and viewer.access.token and viewer.closed


def test_only_host_serves_others(call, viewers):
    call("view", "a")
    assert (viewers[0].access.host, viewers[0].access.token) == ("127.0.0.1", "")


def test_a_folder_without_a_run_is_named(refused, tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "check_viser", lambda what: None)
    pytest.importorskip("viser", reason="viser is absent: pip install 'tracking3d[view]'")
    assert "nowhere is not a run folder: it does not exist" in refused("view", "nowhere")


def test_run_view_opens_with_the_first_answer_and_closes_at_the_end(call, clip, script, viewers):
    result = call("run", clip, *BOX, "--view", "--out", "run")
    assert result.exit_code == 0, result.output
    [viewer] = viewers
    assert viewer.folders == [Path("run")] and viewer.seen == [True] and viewer.closed
    assert np.asarray(viewer.images.image(3)).shape == (48, 64, 3)
    assert "The viewer stays open; Ctrl-C stops it." in result.stderr
    assert RunReader(Path("run")).state == "finished"


def test_a_source_that_gives_each_frame_once_is_shown_as_it_passes(viewers):
    from tracking3d.video import open_source

    frames = [np.full((48, 64, 3), 40 * n, np.uint8) for n in range(4)]
    source = open_source(iter(frames))
    with view_module.watch(source, Path("run"), lambda frame: None, None, True) as (watched, listener):
        assert watched is not source and not watched.repeatable
        listener(None)
        assert [frame.index for frame in watched] == [0, 1, 2, 3]
        assert np.array_equal(viewers[0].images.image(3), frames[3])
    assert viewers[0].closed


def test_host_without_view_is_refused(refused, clip):
    assert "--host is the address that --view serves" in refused("run", clip, *BOX, "--host", "0.0.0.0")


def test_run_without_an_object_hints_at_pick(refused, clip):
    line = refused("run", clip)
    assert "--box" in line and "tracking3d pick" in line


@pytest.fixture
def terminal(monkeypatch):
    """A person is there, as far as ``run`` can see."""

    monkeypatch.setattr(run_module, "a_person_is_there", lambda: True)


def test_run_without_an_object_picks_where_a_person_is_there(call, clip, script, terminal, monkeypatch):
    asked = []

    def picked(source, frames, settings, folder, overwrite=False, menu=None):
        asked.append((source, frames, settings.tracker.name, folder))
        return Picked(2, (CUP,), boxes=[(20.0, 10.0, 20.0, 20.0)])

    monkeypatch.setattr(pick_module, "picked_in_browser", picked)
    assert call("run", clip, "--tracker", "csrt", "--out", "run").exit_code == 0
    assert asked == [(str(clip), None, "csrt", Path("run"))]
    assert [frame.index for frame in RunReader(Path("run")).frames] == [0, 1, 2, 3, 4]
    assert RunReader(Path("run")).description["prompt"]["first_frame"] == 2
    assert script.built[0][1].box == (20, 10, 20, 20)


@pytest.mark.parametrize("options", [["--quiet"], ["--resume"]])
def test_who_wants_no_conversation_gets_the_sentence(refused, clip, terminal, options):
    assert "Give the object" in refused("run", clip, *options)


def test_pick_starts_the_run_both_ways_from_the_frame_that_was_picked_in(call, clip, script, monkeypatch):
    masks = np.zeros((2, 48, 64), bool)
    masks[:, 10:20, 30:50] = True
    monkeypatch.setattr(
        pick_module, "picked_in_browser", lambda *given: Picked(1, (CUP, CUP), masks=list(masks))
    )
    result = call("pick", clip, "--out", "run", "--frames", "0:4")
    assert result.exit_code == 0, result.output
    for number in (0, 1):
        reader = RunReader(Path("run", f"object_{number}"))
        assert [frame.index for frame in reader.frames] == [0, 1, 2, 3]
        assert reader.description["selection"] == "0:4"
        assert reader.description["prompt"]["first_frame"] == 1


def test_pick_refuses_a_folder_with_a_run_before_anything_is_drawn(call, refused, clip, script):
    call("run", clip, *BOX, "--out", "run")
    assert "run already holds a run" in refused("pick", clip, "--out", "run")
    assert script.built[1:] == []


def test_pick_refuses_what_does_not_wait(refused, monkeypatch):
    class Camera:
        name, repeatable, count = "camera 0", False, None

    monkeypatch.setattr("tracking3d.video.open_source", lambda source, frames: Camera())
    assert "camera 0 cannot be paused to draw in" in refused("pick", "0")


def test_the_page_of_pick_is_served_until_the_run_is_started(clip, tmp_path, monkeypatch, capfd):
    import json
    import time
    from urllib.request import Request, urlopen

    from tracking3d.config.loading import load_config

    found: list[Picked] = []
    work = threading.Thread(
        target=lambda: found.append(
            pick_module.picked_in_browser(str(clip), None, load_config(), tmp_path / "run", port=0)
        )
    )
    work.start()
    until, address = time.monotonic() + 30, ""
    while not address and time.monotonic() < until:
        time.sleep(0.05)
        address += capfd.readouterr().err
    base = address.strip().rstrip("/")
    body = json.dumps({"objects": [CUP.model_dump(mode="json")]}).encode()
    headers = {"Origin": base, "Content-Type": "application/json"}
    with urlopen(Request(f"{base}/start", body, headers)) as answer:
        assert "--box 20,10,20,20" in json.loads(answer.read())["command"]
    work.join(30)
    assert found[0].boxes == [(20.0, 10.0, 20.0, 20.0)] and (tmp_path / "run" / "picked.json").is_file()


def test_the_viewer_starts_without_torch():
    code = "import sys, tracking3d.viewer.opening; print({'torch', 'kornia', 'numba'} & set(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout == "set()\n", "loading it takes longer than all else until the page is there"


@pytest.mark.parametrize("command", ["pick", "run"])
def test_the_options_of_the_command_line_are_chosen_on_the_page_and_can_be_changed(
    call, clip, script, terminal, monkeypatch, command
):
    def picked(source, frames, settings, folder, *more, overwrite=False, menu=None):
        menu = more[-1] if more else menu
        first, intrinsics = menu.chosen, (300.0, 300.0, 31.5, 23.5)
        assert (first.tracker, first.quality, first.fov) == ("csrt", "best", 30)
        assert menu.configure(first) == settings and settings.crop.size == 192
        chosen = first.model_copy(update={"model": "none", "fov": None, "intrinsics": intrinsics})
        return Picked(0, (CUP,), boxes=[(20.0, 10.0, 20.0, 20.0)], config=menu.configure(chosen))

    monkeypatch.setattr(pick_module, "picked_in_browser", picked)
    options = ["--tracker", "csrt", "--quality", "best", "--fov", "30", "--out", "run"]
    assert call(command, clip, *options).exit_code == 0
    config = RunReader(Path("run")).config
    assert config["camera"]["intrinsics"] == [300.0, 300.0, 31.5, 23.5] and config["camera"]["fov"] is None
    assert config["object"]["texture_views"] == 0 and config["crop"]["size"] == 192


def test_a_camera_file_of_the_command_line_stays_unless_the_page_names_another_lens(clip, tmp_path):
    from tracking3d.cli.options import SettingsOptions
    from tracking3d.cli.options.camera import CameraOptions
    from tracking3d.cli.options.tracking import TrackingOptions

    file = tmp_path / "cameras.txt"
    file.write_text("1 PINHOLE 64 48 60 60 31.5 23.5\n")
    camera = CameraOptions(intrinsics=str(file))
    menu = pick_module.settings_menu(
        str(clip), None, TrackingOptions(), camera, SettingsOptions(), pick_module._configure
    )
    config = menu.configure(menu.chosen.model_copy(update={"quality": "draft"}))
    assert config.camera.file is not None and str(config.camera.file) == str(file)
    config = menu.configure(menu.chosen.model_copy(update={"fov": 20.0}))
    assert config.camera.file is None and config.camera.fov == 20


def test_the_page_of_the_tracker_auto_shows_the_masks_of_the_one_that_it_stands_for(clip):
    from tracking3d.cli.options import SettingsOptions
    from tracking3d.cli.options.camera import CameraOptions
    from tracking3d.cli.options.tracking import TrackingOptions

    tracking = TrackingOptions(tracker="auto")
    menu = pick_module.settings_menu(
        str(clip), None, tracking, CameraOptions(), SettingsOptions(), pick_module._configure
    )
    assert menu.chosen.tracker == "auto"
    assert menu.configure(menu.chosen).tracker.name in ("segment", "csrt", "onnx", "flow")
