"""Several wheels bring the module cv2; with one that lacks what trackers need, they say which to remove and install."""

from __future__ import annotations

from importlib import metadata

import cv2
import numpy as np
import pytest

from tracking3d.config.models import PluginChoice
from tracking3d.errors import PluginError
from tracking3d.plugins import TRACKERS, build_plugin, list_plugins, load_plugin
from tracking3d.trackers.csrt import CsrtTracker
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.segmentation import SMOOTHER, ColourSegmentation

INSTALL = "`pip install opencv-contrib-python-headless`"


@pytest.fixture
def wheels(monkeypatch):
    """Pretend that OpenCV came with these wheels, and that none of them has the contrib modules."""

    def pretend(*names: str) -> None:
        for absent in ("TrackerCSRT", "TrackerKCF", "ximgproc"):
            monkeypatch.delattr(cv2, absent)
        found = metadata.distribution

        def distribution(name: str) -> metadata.Distribution:
            if not name.startswith("opencv"):
                return found(name)
            if name not in names:
                raise metadata.PackageNotFoundError(name)
            return found("tracking3d")

        monkeypatch.setattr(metadata, "distribution", distribution)

    return pretend


def test_with_the_contrib_build_nothing_is_amiss():
    assert why_no_contrib("TrackerCSRT", "TrackerKCF", SMOOTHER) == ""
    assert "lacks Tracker3000:" in why_no_contrib("TrackerCSRT", "Tracker3000")


@pytest.mark.parametrize(
    ("installed", "remove"),
    [
        (["opencv-python"], "`pip uninstall -y opencv-python`, then "),
        (["opencv-python-headless"], "`pip uninstall -y opencv-python-headless`, then "),
        (
            ["opencv-contrib-python-headless", "opencv-python"],
            "`pip uninstall -y opencv-python opencv-contrib-python-headless`, then ",
        ),
        ([], ""),
    ],
    ids=["plain", "plain headless", "plain over contrib", "from elsewhere"],
)
def test_just_the_wheels_that_are_installed_are_to_be_removed(wheels, installed, remove):
    wheels(*installed)
    assert why_no_contrib("TrackerCSRT") == f"the installed OpenCV lacks TrackerCSRT: {remove}{INSTALL}"


@pytest.mark.parametrize("name", ["csrt", "flow"])
def test_the_list_says_why_a_tracker_does_not_work(wheels, name):
    wheels("opencv-python", "opencv-contrib-python-headless")
    [info] = [info for info in list_plugins() if (info.group, info.name) == (TRACKERS, name)]
    assert info.status == "broken"
    assert SMOOTHER in info.reason
    assert info.reason.endswith(f"uninstall -y opencv-python opencv-contrib-python-headless`, then {INSTALL}")


def test_all_wheels_at_once_still_fit_into_the_reason(wheels):
    wheels(
        "opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless"
    )
    [info] = [info for info in list_plugins() if info.name == "csrt"]
    assert info.reason.endswith(INSTALL)


@pytest.mark.parametrize("name", ["csrt", "flow"])
def test_choosing_such_a_tracker_ends_in_the_same_sentence(wheels, name):
    wheels("opencv-python")
    with pytest.raises(PluginError, match=rf"'{name}'.*pip uninstall -y opencv-python`, then {INSTALL}"):
        load_plugin(TRACKERS, name)


def test_trackers_that_need_no_contrib_modules_go_on_without(wheels, tmp_path):
    wheels("opencv-python")
    np.savez(tmp_path / "masks.npz", masks=np.ones((1, 4, 4), bool))
    build_plugin(TRACKERS, PluginChoice(name="precomputed", path=str(tmp_path / "masks.npz")))
    assert {info.name: info.status for info in list_plugins()}["onnx"] == "ok"


def test_a_box_tracker_that_an_option_asks_for_is_missed_when_it_is_built(wheels, monkeypatch):
    from tracking3d.trackers.flow import FlowTracker
    from tracking3d.trackers.onnx.boxes import CsrtBoxes

    wheels("opencv-python")
    with pytest.raises(PluginError, match=rf"box tracker csrt .* lacks TrackerCSRT: .*{INSTALL}"):
        CsrtBoxes(CsrtTracker.Options())
    for witness, absent in (("csrt", "TrackerCSRT"), ("kcf", "TrackerKCF")):
        with pytest.raises(PluginError, match=rf"box tracker {witness} .* lacks {absent}: .*{INSTALL}"):
            FlowTracker.from_options(FlowTracker.Options(witness=witness))


def test_a_plugin_of_another_package_that_segments_by_colour_gets_the_sentence_too(wheels):
    wheels("opencv-python-headless")
    with pytest.raises(PluginError, match=rf"colour segmentation .*{SMOOTHER}: .*-headless`, then {INSTALL}"):
        ColourSegmentation(np.zeros((20, 20, 3), np.uint8), (5, 5, 10, 10))


def test_the_command_line_lists_and_refuses_without_a_traceback(wheels, tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from tracking3d.cli import app

    wheels("opencv-python")
    monkeypatch.setenv("COLUMNS", "300")
    listed = CliRunner().invoke(app, ["plugins"]).stdout
    [csrt] = [line for line in listed.splitlines() if " csrt " in line]
    assert "broken" in csrt and "pip uninstall -y opencv-python" in csrt
    result = CliRunner().invoke(app, ["run", str(tmp_path), "--box", "1,1,5,5", "--tracker", "csrt"])
    assert result.exit_code == 2
    [line] = result.stderr.splitlines()
    assert line.startswith("error: mask tracker 'csrt' (tracking3d ") and INSTALL in line
