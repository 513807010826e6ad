"""The commands beside ``run``: what they print, as text and as JSON, and how they refuse bad input."""

from __future__ import annotations

import csv
import functools
import io
import json
import shutil
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import yaml

from tracking3d.config.loading import load_config
from tracking3d.testing.synthesis import convex_clips

BOX = ("--box", "20,10,20,20")
HEAVY = {"cv2", "kornia", "numba", "numpy", "rich.progress", "scipy", "torch", "trimesh"}
COMMANDS = ["run", "demo", "synth", "points", "export", "config show", "config schema", "config validate"]
COMMANDS += ["plugins list", "plugins new", "models list", "models get", "models verify"]
COMMANDS += [f"evaluate {command}" for command in ("answers", "suite", "table", "compare", "spread", "peer")]
GROUPS = ["config", "bench", "bench render", "evaluate", "models", "plugins"]


@pytest.fixture
def finished(call, clip, script) -> Path:
    """A finished run of the fake session, which answers with one mask in every frame."""
    assert call("run", clip, *BOX, "--out", "run").exit_code == 0
    return Path("run")


@pytest.mark.parametrize("command", ["", *COMMANDS, *GROUPS])
def test_every_command_has_help(call, command):
    result = call(*command.split(), "--help")
    assert result.exit_code == 0
    assert "Usage:" in result.stdout
    assert command not in COMMANDS or "--debug" in result.stdout
    assert "<bool>" not in result.stdout


def test_version(call):
    result = call("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("tracking3d 0.")


def test_no_command_prints_the_help(call):
    assert "Usage:" in call().stdout
    assert "Usage:" in call("config").stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [("rnu", "did you mean 'run'"), ("config shwo", "did you mean 'show'"), ("--nonsense", "no such option")],
)
def test_unknown_command_is_one_sentence(refused, arguments, words):
    assert words in refused(*arguments.split()).lower()


def test_importing_the_command_line_loads_nothing_heavy():
    code = f"import sys, tracking3d.cli; print({HEAVY} & set(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout == "set()\n"


@pytest.mark.parametrize("command", ["", "run", "batch run", "evaluate table"])
def test_help_loads_nothing_heavy(command):
    code = (
        "import atexit, sys; from tracking3d.cli import main\n"
        f"atexit.register(lambda: print({HEAVY} & set(sys.modules), file=sys.stderr)); main()"
    )
    program = [sys.executable, "-c", code, *command.split(), "--help"]
    answer = subprocess.run(program, capture_output=True, text=True, check=True)
    assert "Usage:" in answer.stdout
    assert answer.stderr == "set()\n"


def test_broken_pipe_ends_quietly():
    code = "from tracking3d.cli import main; main()"
    program = subprocess.Popen(
        [sys.executable, "-c", code, "config", "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    program.stdout.close()
    assert program.stderr.read() == b""
    program.stderr.close()
    program.wait()


def test_a_closed_standard_output_is_no_fault():
    code = "from tracking3d.cli import main; main()"
    command = ["bash", "-c", 'exec "$@" 0<&- 1>&-', "bash", sys.executable, "-c", code, "config", "schema"]
    result = subprocess.run(command, stderr=subprocess.PIPE)
    assert (result.returncode, result.stderr) == (0, b"")


def test_plugins_are_listed_with_status_and_reason(call, monkeypatch):
    monkeypatch.setenv("TRACKING3D_PLUGINS", "tracking3d.trackers:bad=no_such_module_at_all:Bad")
    result = call("plugins")
    assert result.exit_code == 0
    [csrt] = [line for line in result.stdout.splitlines() if "csrt" in line]
    assert [cell.strip() for cell in csrt.strip("│").split("│")][:3] == [
        "csrt",
        "tracking3d.trackers",
        "tracking3d",
    ]
    [bad] = [line for line in result.stdout.splitlines() if "bad" in line]
    assert "broken" in bad
    assert "No module named 'no_such_module_at_all'" in bad


def test_plugins_alone_lists_them(call):
    assert call("plugins").stdout == call("plugins", "list").stdout


def test_plugins_new_writes_a_package_or_says_why_not(call, refused):
    result = call("plugins", "new", "my-colour", "--kind", "tracker", "--out", "here")
    assert (result.exit_code, Path("here/tracking3d-my-colour/pyproject.toml").is_file()) == (0, True)
    assert "pip install here/tracking3d-my-colour pytest && pytest here/tracking3d-my-colour" in result.stdout
    assert "exists" in refused("plugins", "new", "my-colour", "--kind", "tracker", "--out", "here")
    assert "cannot be the name of a plug-in" in refused("plugins", "new", "My_Colour", "--kind", "tracker")
    assert "taken by the mask tracker 'csrt'" in refused("plugins", "new", "csrt", "--kind", "tracker")
    assert "--kind" in refused("plugins", "new", "mine")
    assert "--kind" in refused("plugins", "new", "mine", "--kind", "solver")


def test_a_new_plugin_in_the_working_directory_is_a_folder_to_pip_and_not_a_name_on_its_index(call):
    result = call("plugins", "new", "my-colour", "--kind", "tracker")
    assert "pip install ./tracking3d-my-colour pytest && pytest ./tracking3d-my-colour" in result.stdout


def test_a_new_plugin_s_commands_are_quoted_for_the_shell(call):
    result = call("plugins", "new", "my-colour", "--kind", "tracker", "--out", "my plug-ins")
    assert "pip install 'my plug-ins/tracking3d-my-colour' pytest" in result.stdout


def test_plugins_as_json(call):
    infos = {info["name"]: info for info in json.loads(call("plugins", "--json").stdout)}
    assert set(infos["csrt"]) == {"name", "group", "package", "version", "status", "reason", "options"}
    assert "path" in infos["precomputed"]["options"]["properties"]


def test_config_show_says_what_each_layer_sets(call):
    result = call("config", "show", "--quality", "draft")
    preset, quality = result.stderr.splitlines()
    assert preset == "# preset default: changes nothing"
    assert quality == "# quality draft: tracker.name=flow, crop.size=96, solver.final_refine=False"
    assert yaml.safe_load(result.stdout)["crop"]["size"] == 96
    assert yaml.safe_load(call("config", "show", "--quality", "best").stdout)["tracker"] == {"name": "auto"}


def test_config_show_is_a_configuration_file_with_every_default(call, tmp_path):
    result = call("config", "show", "--preset", "paper", "--set", "crop.size=64")
    shown = yaml.safe_load(result.stdout)
    assert shown["crop"]["size"] == 64
    assert shown["tracker"]["padding"] > 0
    (tmp_path / "shown.yaml").write_text(result.stdout)
    assert load_config(tmp_path / "shown.yaml").crop.size == 64
    assert call("config", "show", "--config", "shown.yaml").stdout == result.stdout


def test_config_show_refuses_what_run_would_refuse(refused):
    assert "did you mean 'network'?" in refused("config", "show", "--set", "tracker.networ=1")
    assert "option 'path' is missing" in refused("config", "show", "--set", "tracker=precomputed")


def test_config_schema_is_json(call):
    schema = json.loads(call("config", "schema").stdout)
    assert {"tracker", "solver", "preset"} <= set(schema["properties"])


def test_config_validate_checks_the_plugins_own_options(call, refused, tmp_path):
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    good.write_text("tracker: {name: csrt, padding: 2}")
    result = call("config", "validate", good)
    assert (result.exit_code, result.stdout) == (0, f"{good} is valid\n")
    for text, words in [
        ("tracker: {name: csrt, paddin: 2}", "did you mean 'padding'?"),
        ("tracker: {name: csrt, padding: wide}", "'padding' must be a valid number"),
        ("tracker: crst", "did you mean 'csrt'?"),
        ("- tracker", "has a list"),
        ("solver: !!python/name:os.system", "never run code"),
    ]:
        bad.write_text(text)
        assert words in refused("config", "validate", bad)


@pytest.fixture
def truth(clip, tmp_path, mask_file) -> Path:
    """A clip whose true masks are what the fake session answers."""
    folder = tmp_path / "truth"
    shutil.copytree(clip, folder / "frames")
    (folder / "masks").mkdir()
    mask = np.zeros((48, 64), dtype=bool)
    mask[10:30, 20:40] = True
    for index in range(5):
        mask_file(mask, f"truth/masks/{index:03d}.png")
    return folder


def test_evaluate_prints_a_table_or_json_only(call, finished, truth):
    scores = json.loads(call("evaluate", finished, "--truth", truth, "--json").stdout)
    assert scores["iou_mean"] == scores["iou_initial_mean"] == 1
    assert scores["frames"] == 5
    assert {"rotation_error_mean_deg", "rotation_error_median_deg", "share_under_5_deg"} <= set(scores)
    assert {"rotation_error_anchored_median_deg", "share_worse_than_initial"} <= set(scores)
    result = call("evaluate", finished, "--truth", truth)
    assert result.exit_code == 0
    assert "IoU" in result.stdout
    assert "5 of 5 estimated frames match frames of the clip, 0 to 4 of its 5." in result.stderr
    shifted = call("evaluate", finished, "--truth", truth, "--offset", 1)
    assert "4 of 5 estimated frames match frames of the clip, 1 to 4 of its 5." in shifted.stderr


def test_evaluate_names_the_folder_that_is_none(refused, finished, truth):
    assert "absent" in refused("evaluate", "absent", "--truth", truth)
    assert "absent" in refused("evaluate", finished, "--truth", "absent")
    assert "--truth" in refused("evaluate", finished)


def test_points_are_a_table_on_a_terminal(finished, monkeypatch, capsys):
    from tracking3d.cli.points import _print
    from tracking3d.results.correspondences import track_points
    from tracking3d.results.run_reader import RunReader

    tracks = track_points(RunReader(finished), 0, [(31.5, 23.5)])
    _print(tracks, as_json=False)
    assert capsys.readouterr().out.startswith("frame,point,x,y")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    _print(tracks, as_json=False)
    shown = capsys.readouterr().out
    assert "frame,point" not in shown and "┃" in shown


def test_points_are_followed_as_csv_and_json(call, finished):
    pixels = ("--xy", "31.5,23.5", "--xy", "0,0")
    rows = list(csv.DictReader(io.StringIO(call("points", finished, "--frame", 0, *pixels).stdout)))
    assert len(rows) == 10
    assert float(rows[0]["x"]) == pytest.approx(31.5, abs=0.01)
    assert (rows[0]["on_object"], rows[1]["on_object"]) == ("1", "0")
    result = call("points", finished, *pixels, "--json")
    assert "These pixels of frame 0 are outside the object's mesh: 0,0;" in result.stderr
    tracks = json.loads(result.stdout)
    assert tracks["frames"] == [0, 1, 2, 3, 4]
    result = call("points", finished, *pixels, "--csv", "points.csv")
    assert (result.exit_code, result.stdout) == (0, "")
    assert list(csv.DictReader(io.StringIO(Path("points.csv").read_text()))) == rows


def test_points_beside_the_object_are_followed_in_the_images_with_any(call, finished):
    rows = list(
        csv.DictReader(io.StringIO(call("points", finished, "--xy", "31.5,23.5", "--xy", "1,1").stdout))
    )
    assert [row["kind"] for row in rows[:2]] == ["surface", "none"]
    result = call("points", finished, "--xy", "31.5,23.5", "--xy", "1,1", "--any")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert [row["kind"] for row in rows[:2]] == ["surface", "image"]
    assert float(rows[1]["x"]) == 1 and rows[1]["on_object"] == "0" and float(rows[1]["uncertainty"]) > 0
    assert "Tracked in the images: 1 of 2 points; 0 of them reached the mesh" in result.stderr
    quiet = call("points", finished, "--xy", "1,1", "--any", "--quiet", "--json")
    assert quiet.stderr == ""
    assert json.loads(quiet.stdout)["kind"] == ["image"]


def test_points_are_followed_in_another_run_too(call, finished):
    """Here the run itself."""
    result = call("points", finished, "--xy", "31.5,23.5", "--in", finished, "--frame", 1, "--quiet")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert [row["run"] for row in rows] == ["0"] * 5 + ["1"] * 5
    for here, there in zip(rows[:5], rows[5:], strict=True):
        assert float(here["x"]) == pytest.approx(float(there["x"]), abs=0.5)
        assert here["frame"] == there["frame"]
    refused = call("points", finished, "--xy", "31.5,23.5", "--in", finished, "--any")
    assert refused.exit_code == 2 and "leave out --any and --by-mesh" in refused.stderr


def test_points_of_a_grid_are_drawn_and_need_no_video_by_mesh(call, finished):
    result = call("points", finished, "--grid", 8, "--frame", 2, "--video", "trails.mp4", "--quiet")
    assert (result.exit_code, result.stdout) == (0, "")
    assert Path("trails.mp4").stat().st_size > 1000
    by_mesh = call("points", finished, "--grid", 8, "--by-mesh").stdout
    assert {row["measured"] for row in csv.DictReader(io.StringIO(by_mesh))} == {"0"}


def test_points_without_their_video_are_carried_by_the_mesh_and_that_is_said(call, finished):
    run_json = finished / "run.json"
    run_json.write_text(run_json.read_text().replace('"source": "', '"source": "gone/'))
    result = call("points", finished, "--xy", "31,23")
    assert "mesh and pose alone" in result.stderr
    assert "--source" in result.stderr
    assert len(result.stdout.splitlines()) == 6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("points absent --xy 1,1", "absent"),
        ("points run", "--xy"),
        ("points run --grid 0", "--grid"),
        ("points run --grid 500", "smaller --grid"),
        ("points run --xy 31,23 --source absent", "--source"),
        ("points run --xy 31,23 --video run/no/trails.mp4", "run/no/trails.mp4"),
        ("points run --xy 1", "--xy '1' is not 2 numbers"),
        ("points run --xy a,b", "--xy 'a,b' is not 2 numbers"),
        ("points run --xy nan,1", "--xy 'nan,1' is not 2 numbers"),
        ("points run --xy 1,1 --frame 9", "9"),
        ("points run --xy 1,1 --frame x", "--frame"),
        ("points run --xy 31,23 --csv run/no/points.csv", "run/no/points.csv"),
        ("points run --xy 31,23 --xy 64,23", "Frame 0 has no pixel 64,23: it has 64 x 48 pixels"),
        ("points run --xy 31,-1", "has no pixel 31,-1"),
        (
            "points run --xy 1,1 --xy 2,1",
            "These pixels of frame 0 are outside the object's mesh: 1,1 and 2,1;",
        ),
        ("points run --xy 1,1", "or --any to follow them in the images alone"),
        (
            "points run --xy 1,1 --any --by-mesh",
            "--any tracks points in the images, which --by-mesh does not read",
        ),
        ("points run --xy 99,1 --any", "Frame 0 has no pixel 99,1"),
    ],
)
def test_bad_question_for_points_is_refused(refused, finished, arguments, words):
    assert words in refused(*arguments.split())


def test_bench_render_prints_the_benchmark(call, refused, monkeypatch):
    module = types.ModuleType("bench_render")
    module.benchmark = lambda *given, **named: {"given": given, **named}
    monkeypatch.setitem(sys.modules, "tracking3d_bench.speed.benchmark", module)
    options = ["--size", 64, "--frames", 2, "--channels", 8, "--repeats", 3, "--no-dense"]
    result = call("bench", "render", *options, "--json")
    given = [64, 2, 8, None, 3, 1, "cpu"]
    assert json.loads(result.stdout) == {"given": given, "dense": False, "growth": False}
    assert "--frames" in refused("bench", "render", "--frames", "0")


def test_demo_writes_clip_run_and_summary(call, script, monkeypatch):
    quick = functools.partial(convex_clips.make_demo_clip, frames=3, size=(64, 48))
    monkeypatch.setattr(convex_clips, "make_demo_clip", quick)
    for _ in range(2):  # a second call replaces the first's files
        result = call("demo", "--out", "shown", "--seed", 3)
        assert result.exit_code == 0, result.output
    summary = json.loads(Path("shown/summary.json").read_text())
    names = [
        "iou_initial",
        "iou",
        "rotation_error_mean_deg",
        "rotation_error_median_deg",
        "seconds_per_frame",
    ]
    assert list(summary) == names
    assert all(name in result.stdout for name in names)
    assert Path("shown/run/run.json").exists()
    assert Path("shown/clip/poses.json").exists()
    *_, opened, next_step = result.stdout.splitlines()
    assert opened.startswith(f"Open {Path('shown/run/report.html')} in a browser")
    assert Path("shown/run/report.html").is_file()
    assert "tracking3d run VIDEO --box" in next_step
    config, prompt = script.built[-1]
    assert (config.tracker.name, config.features.name, config.runtime.seed) == ("csrt", "rgb", 3)
    assert prompt.mask is None
