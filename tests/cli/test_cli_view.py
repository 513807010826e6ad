"""``tracking3d view`` and ``pick``, and ``run`` with the browser: what they hand on, and what they say without it."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tracking3d.cli import pick as pick_module
from tracking3d.cli import run as run_module
from tracking3d.cli import view as view_module
from tracking3d.cli.tracking import RunRequest
from tracking3d.config.loading import load_config
from tracking3d.pipeline.record import RecordOptions
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.ui.picker.correction import read_outcome, save_outcome
from tracking3d.ui.picker.drawing import DrawnObject
from tracking3d.ui.picker.session import Picked
from tracking3d.ui.viewer import opening
from tracking3d.ui.web.access import Access

BOX = ("--box", "20,10,20,20")


class Page:
    """Stands in for the page on which the object is picked."""

    access, address = Access(), "http://127.0.0.1:8090/"

    def __init__(self, drawn: Picked, before: bool = False) -> None:
        self._drawn, self.picked = drawn, drawn if before else None
        self.shown: list[object] = []

    def __setattr__(self, name, value):
        if name == "run":
            self.shown.append(value.progress())
        super().__setattr__(name, value)

    def wait(self) -> Picked:
        return self._drawn

    def wait_until_left(self) -> None:
        pass

    def close(self) -> None:
        pass


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

    def picked(request, menu):
        asked.append((request.source, request.options.selection, request.config.tracker.name, request.folder))
        return Page(Picked(2, (CUP,), boxes=[(20.0, 10.0, 20.0, 20.0)]))

    monkeypatch.setattr(run_module, "open_picker", picked)
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
    page = Page(Picked(1, (CUP, CUP), masks=list(masks)))
    monkeypatch.setattr(pick_module, "open_picker", lambda *given: page)
    result = call("pick", clip, "--out", "run", "--frames", "0:4")
    assert result.exit_code == 0, result.output
    assert page.shown[0].running and page.shown[0].sentence
    assert not page.shown[-1].running and page.shown[-1].sentence == "The run is finished."
    for number in (0, 1):
        reader = RunReader(Path("run", f"object_{number}"))
        assert [frame.index for frame in reader.frames] == [0, 1, 2, 3]
        assert reader.description["selection"] == "0:4"
        assert reader.description["prompt"]["first_frame"] == 1


def test_a_picked_run_that_was_stopped_is_continued_by_picking_again_or_by_the_line_that_is_told(
    call, clip, script, monkeypatch
):
    opened = []

    def open_page(request, *given):
        drawn = Picked(2, (CUP,), boxes=[(20.0, 10.0, 20.0, 20.0)], config=request.config)
        before = read_outcome(request.folder)
        save_outcome(drawn, request.config, request.folder, request.source)
        opened.append(before)
        return Page(drawn, before is not None)

    monkeypatch.setattr(pick_module, "open_picker", open_page)
    script.faults[4] = KeyboardInterrupt()
    result = call("pick", clip, "--out", "run")
    assert result.exit_code == 130
    [line] = [one for one in result.stderr.splitlines() if one.startswith("To continue")]
    assert line == (
        f"To continue from there: tracking3d run {clip} --box 20,10,20,20 --start-frame 2 --config run/picked.yaml "
        "--out run --resume"
    )
    script.faults.clear()
    shutil.copytree("run", "kept")
    assert call("pick", clip, "--out", "run").exit_code == 0
    assert opened[0] is None
    assert (opened[1].frame, opened[1].boxes) == (2, [(20.0, 10.0, 20.0, 20.0)])
    assert opened[1].config == load_config(Path("run/picked.yaml"))
    shutil.rmtree("run")
    shutil.move("kept", "run")
    assert call(*shlex.split(line.partition("tracking3d ")[2])).exit_code == 0
    assert RunReader(Path("run")).state == "finished"
    assert read_outcome(Path("run")) is None


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
    from urllib.request import Request, urlopen

    request = RunRequest(str(clip), load_config(), tmp_path / "run", PromptSet(), RecordOptions())
    page = pick_module.open_picker(request, None, port=0)
    base = capfd.readouterr().err.strip().rstrip("/")
    body = json.dumps({"objects": [CUP.model_dump(mode="json")]}).encode()
    headers = {"Origin": base, "Content-Type": "application/json"}
    with urlopen(Request(f"{base}/start", body, headers)) as answer:
        assert "--box 20,10,20,20" in json.loads(answer.read())["command"]
    assert page.wait().boxes == [(20.0, 10.0, 20.0, 20.0)] and (tmp_path / "run" / "picked.json").is_file()
    page.close()


def test_the_viewer_starts_without_torch():
    code = "import sys, tracking3d.ui.viewer.opening; print({'torch', 'kornia', 'numba'} & set(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout == "set()\n", "loading it takes longer than all else until the page is there"


@pytest.mark.parametrize("command", ["pick", "run"])
def test_the_options_of_the_command_line_are_chosen_on_the_page_and_can_be_changed(
    call, clip, script, terminal, monkeypatch, command
):
    def picked(request, menu, *more):
        first, intrinsics = menu.chosen, (300.0, 300.0, 31.5, 23.5)
        assert (first.tracker, first.quality, first.fov) == ("csrt", "best", 30)
        assert menu.configure(first) == request.config and request.config.crop.size == 192
        chosen = first.model_copy(update={"model": "none", "fov": None, "intrinsics": intrinsics})
        return Page(Picked(0, (CUP,), boxes=[(20.0, 10.0, 20.0, 20.0)], config=menu.configure(chosen)))

    for module in (pick_module, run_module):
        monkeypatch.setattr(module, "open_picker", picked)
    options = ["--tracker", "csrt", "--quality", "best", "--fov", "30", "--out", "run"]
    assert call(command, clip, *options).exit_code == 0
    config = RunReader(Path("run")).config
    assert config["camera"]["intrinsics"] == [300.0, 300.0, 31.5, 23.5] and config["camera"]["fov"] is None
    assert config["object"]["texture_views"] == 0 and config["crop"]["size"] == 192


def test_a_camera_file_of_the_command_line_stays_unless_the_page_names_another_lens(clip, tmp_path):
    from tracking3d.cli.options import SettingsOptions
    from tracking3d.cli.options.tracking import CameraOptions, TrackingOptions

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
    from tracking3d.cli.options.tracking import CameraOptions, TrackingOptions

    tracking = TrackingOptions(tracker="auto")
    menu = pick_module.settings_menu(
        str(clip), None, tracking, CameraOptions(), SettingsOptions(), pick_module._configure
    )
    assert menu.chosen.tracker == "auto"
    assert menu.configure(menu.chosen).tracker.name in ("segment", "csrt", "onnx", "flow")
