"""The Python and YAML of the documentation does what the text says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from documentation_pages import HOW_TO, ROOT, blocks, label, pages_with
from scipy.spatial.transform import Rotation

from tracking3d.config.loading import load_config
from tracking3d.config.models import PluginChoice
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, Prompt
from tracking3d.pipeline.tracker_selection import check_tracker_options
from tracking3d.plugins import FEATURES, TRACKERS, build_plugin, check_options
from tracking3d.testing.synthesis.convex_clips import SyntheticClip
from tracking3d.trackers.protocol import MaskTracker


@pytest.mark.parametrize("page", [page for page in pages_with("python") if page not in HOW_TO], ids=label)
def test_python_of_a_page_runs_from_top_to_bottom(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    program: dict = {"__name__": "documented"}
    for block in blocks(page, "python"):
        exec(compile(block, f"{label(page)}, a block", "exec"), program)
    if page == ROOT / "README.md":
        check_that_the_object_is_tracked(program["estimates"], program["clip"])
        check_that_it_prints(capsys.readouterr().out, blocks(page, "text")[0])
    if page.name == "library.md":
        assert program["run"].state == "finished"
        assert len(program["poses"]) == len(program["frames"]) == len(program["run"].frames)
        assert program["tracks"].on_object.all()


def check_that_the_object_is_tracked(estimates: dict[int, FrameEstimate], clip: SyntheticClip):
    assert list(estimates) == list(range(len(clip.images)))
    assert {estimate.status for estimate in estimates.values()} == {Status.TRACKED}
    last = len(clip.images) - 1
    turned, truly_turned = (
        Rotation.from_matrix(poses[last][:3, :3] @ poses[0][:3, :3].T)
        for poses in ([estimates[index].T_cam_obj for index in sorted(estimates)], clip.T_cam_obj)
    )
    assert np.degrees(truly_turned.magnitude()) > 20
    assert np.degrees((turned.inv() * truly_turned).magnitude()) < 8


def check_that_it_prints(printed: str, shown: str):
    """The same lines; positions and areas within what rounding on another processor may change."""
    for line, expected in zip(printed.splitlines(), shown.splitlines(), strict=True):
        now, then = (re.findall(r"-?\d+\.?\d*", text) for text in (line, expected))
        assert re.sub(r"[-\d. ]", "", line) == re.sub(r"[-\d. ]", "", expected)
        np.testing.assert_allclose(np.float64(now), np.float64(then), rtol=0.01, atol=0.02, err_msg=line)


def test_documented_plugins_work_through_the_environment_variable(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks(ROOT / "docs/plugins.md", "python"):
        name = block.partition("\n")[0].removeprefix("# ")
        Path(name).write_text(block, encoding="utf-8")
    export = next(
        line.removeprefix("$ export TRACKING3D_PLUGINS=").strip('"')
        for line in "".join(blocks(ROOT / "docs/plugins.md", "console")).splitlines()
        if "TRACKING3D_PLUGINS=" in line
    )
    monkeypatch.setenv("TRACKING3D_PLUGINS", export)
    tracker = build_plugin(TRACKERS, PluginChoice(name="colour", distance=40))
    encoder = build_plugin(FEATURES, PluginChoice(name="lab"))
    assert isinstance(tracker, MaskTracker)
    assert isinstance(encoder, FeatureEncoder)

    image = np.zeros((40, 60, 3), np.uint8)
    image[10:30, 20:40] = 200, 30, 30
    answer = tracker.init(Frame(0, image), Prompt((20, 10, 20, 20)))
    np.testing.assert_array_equal(answer.binary, image[..., 0] > 0)
    np.testing.assert_array_equal(tracker.step(Frame(1, image)).binary, image[..., 0] > 0)


@pytest.mark.parametrize("page", pages_with("yaml"), ids=label)
def test_documented_configurations_are_valid(page, tmp_path):
    for block in blocks(page, "yaml"):
        file = tmp_path / "documented.yaml"
        file.write_text(block, encoding="utf-8")
        config = load_config(file)
        check_tracker_options(config)
        check_options(FEATURES, config.features)
