"""A name by which users look for a tracker, features or a format is answered with what exists."""

from __future__ import annotations

import pytest
from recorded_runs import write_run

from tracking3d.errors import InputError, PluginError
from tracking3d.export.exporting import OTHER_NAMES, find_format
from tracking3d.export.formats import FORMATS
from tracking3d.plugins import FEATURES, TRACKERS, plugin_label

BOX = ("--box", "20,10,20,20")


@pytest.mark.parametrize(
    ("name", "meant"),
    [("usd", "usdz"), ("ros", "ros-bag"), ("gltf", "glb or animated-glb"), ("obj", "glb or nuke")],
)
def test_an_export_to_a_format_that_does_not_exist(refused, tmp_path, name, meant):
    line = refused("export", write_run(tmp_path / "run", 1), "--to", name)
    assert line.startswith(f"error: There is no format {name} (--to takes tum, kitti, ")
    assert line.endswith(f"); did you mean {meant}?")


@pytest.mark.parametrize(
    ("name", "meant"),
    [(".gltf", "glb or animated-glb"), ("GLB", "glb"), ("rosbag", "ros-bag"), ("cut_outs", "cut-outs")],
)
def test_formats_are_found_by_suffix_and_by_near_miss(name, meant):
    with pytest.raises(InputError) as caught:
        find_format(name)
    assert str(caught.value).endswith(f"; did you mean {meant}?")


def test_a_format_that_nothing_comes_close_to_is_answered_with_all():
    with pytest.raises(InputError, match=r"takes tum, .*, rerun\.$"):
        find_format("qqq")


def test_what_is_suggested_exists():
    for name, formats in OTHER_NAMES.items():
        assert name not in FORMATS
        assert set(formats) & set(FORMATS), name


@pytest.mark.usefixtures("script")
@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("mobilesam", "MobileSAM is the plug-in tracking3d-sam (--tracker sam), or "),
        ("MobileSAM", "MobileSAM is the plug-in tracking3d-sam (--tracker sam), or "),
        ("sam2.1_hiera_tiny", "SAM 2 and EdgeTAM are the plug-in tracking3d-sam2 (--tracker sam2), "),
        ("EdgeTAM", "SAM 2 and EdgeTAM are the plug-in tracking3d-sam2 (--tracker sam2), "),
    ],
)
def test_segment_anything_is_answered_with_the_plugin_and_with_masks(refused, clip, name, advice):
    line = refused("run", clip, *BOX, "--tracker", name, "--out", "out", "--quiet")
    assert line.startswith(f"error: There is no mask tracker '{name}' (installed: csrt, ")
    assert f"; {advice}" in line
    assert line.endswith("masks of other programs are read with --masks.")


@pytest.mark.parametrize(
    ("group", "name", "advice"),
    [
        (TRACKERS, "XMem", "; masks of other programs are read with --masks."),
        (TRACKERS, "csr-dcf", "; did you mean 'csrt'?"),
        (TRACKERS, "flwo", "; did you mean 'flow'?"),
        (FEATURES, "SIFT", "; kornia has it: --features kornia."),
        (FEATURES, "none", "; did you mean 'rgb'?"),
        (FEATURES, "s2d", "; did you mean 's2dnet'?"),
    ],
)
def test_names_of_plugins(group, name, advice):
    with pytest.raises(PluginError) as caught:
        plugin_label(group, name)
    assert str(caught.value).endswith(advice)


def test_a_name_that_nothing_is_known_about_gets_no_advice():
    with pytest.raises(PluginError, match=r"There is no mask tracker 'qqq' \(installed: csrt, .*\)\.$"):
        plugin_label(TRACKERS, "qqq")
