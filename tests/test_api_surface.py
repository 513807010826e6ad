"""What users of the library rely on: removing or renaming any of it fails here, see "What stays" in docs/library.md.

``api_surface.json`` holds the arguments of all that is listed here, with their kinds and defaults. Arguments may be
added if they have a default; then, and where something was taken back as the policy says, write it anew with
``python tests/test_api_surface.py``.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import tracking3d
from tracking3d_bench.evaluation.score import Scores

EXACT = {
    "tracking3d": """Frame FrameEstimate ObjectModel PipelineConfig Prompt Session StageProgress Status __version__
        export_run listen_to_progress load_config track track_objects Tracking TrackingResult""",
    "tracking3d.modules": """LaplacianLoss MeshRenderer OutlineLoss Silhouette SilhouetteLoss TextureLoss
        TexturedMesh RenderedViews camera_from_pinhole pinhole_of_camera pose_from_se3 quaternion_from_kornia
        quaternion_of_pose se3_from_matrix se3_of_pose""",
    "tracking3d.plugins": """FEATURES KEYPOINTS PluginInfo TRACKERS VARIABLE build_plugin check_options list_plugins
        load_plugin plugin_label""",
    "tracking3d.testing": "check_encoder check_tracker",
    "tracking3d.rendering": """BackProjection BackendName Contour MatchedPoints NormalEquations PoseTarget PoseTerms
        Rendering Scales SeenTexels SoftBand Surface TexelMap Visibility back_project channels_last contour_loss
        contour_normal_equations find_contour interpolate pose_normal_equations pose_terms prepare_backend project
        rasterize render sample_texture seen_texels signed_distance soft_silhouette texture_losses visible_texels
        visible_vertices""",
    "tracking3d.video": """FrameSource Intrinsics LatestFrames VideoWriter natural_order open_source parse_selection
        read_image""",
}
"""Packages that say in ``__all__`` what is public: exactly this."""

AT_LEAST = {
    "tracking3d.batch.running": "run_batch",
    "tracking3d.batch.video_job": "VideoJob",
    "tracking3d.config.loading": "load_config",
    "tracking3d.config.models": "PipelineConfig",
    "tracking3d.engines.choosing": "InThisProcess",
    "tracking3d.errors": "InputError OutputError PluginError Tracking3dError",
    "tracking3d.estimation.estimate": "FrameEstimate ObjectModel Status",
    "tracking3d.estimation.solver": "Solver",
    "tracking3d.export.exporter": "Exporter",
    "tracking3d.export.options": "ExportOptions",
    "tracking3d.export.supervision_detections": "detections",
    "tracking3d.features.protocol": "FeatureEncoder KeypointDetector Keypoints",
    "tracking3d.frames": "Box Frame Image MaskEstimate Prompt SkippedFrame",
    "tracking3d.geometry.camera": "Camera Window",
    "tracking3d.geometry.prototypes": "sphere",
    "tracking3d.modules": """LaplacianLoss MeshRenderer SilhouetteLoss TexturedMesh camera_from_pinhole
        pinhole_of_camera pose_from_se3 se3_from_matrix""",
    "tracking3d.features.networks.session": "Network",
    "tracking3d.features.networks.store": "find_network",
    "tracking3d.pipeline.correct": "correct_run",
    "tracking3d.pipeline.record": "RecordOptions record",
    "tracking3d.points.answers": "PointAnswers",
    "tracking3d.trackers.prompts.corrections": "Correction",
    "tracking3d.trackers.prompts.prompt": "make_prompt parse_box",
    "tracking3d.rendering": """SoftBand Surface TexelMap Visibility channels_last contour_normal_equations find_contour
        pose_normal_equations prepare_backend render signed_distance texture_losses visible_texels
        visible_vertices""",
    "tracking3d.ui.report.run_report": "write_report",
    "tracking3d.results.correspondences": "PointTracks track_points",
    "tracking3d.results.mesh_export": "load_model",
    "tracking3d.results.point_tracking": "open_scene",
    "tracking3d.results.run_reader": "RunReader",
    "tracking3d.results.run_unit": "visible_side",
    "tracking3d.testing.synthesis.convex_clips": "SyntheticSpec synthesize",
    "tracking3d.testing": "check_encoder check_tracker",
    "tracking3d.trackers.crops": "box_iou box_of clip_box paste_mask",
    "tracking3d.trackers.csrt": "BoxTracker CsrtTracker",
    "tracking3d.trackers.mask_files": "open_masks",
    "tracking3d.trackers.onnx.tracker": "OnnxTracker",
    "tracking3d.trackers.precomputed": "PrecomputedMasks",
    "tracking3d.trackers.protocol": "CorrectableTracker MaskTracker Options",
    "tracking3d.trackers.segmentation": "ColourSegmentation",
    "tracking3d.video": "LatestFrames open_source",
}
"""Names that the documentation, the examples and our own plug-ins import."""

FIELDS = {
    tracking3d.Frame: "index image time name",
    tracking3d.Prompt: "box mask points",
    tracking3d.FrameEstimate: """index time T_cam_obj mask initial_mask status reason confidence losses
        iterations keyframe seconds failure revised camera points""",
    tracking3d.ObjectModel: "vertices faces face_uvs texture texture_weight features",
    Scores: """iou_initial_mean iou_mean rotation_error_mean_deg rotation_error_median_deg
        rotation_error_anchored_median_deg share_under_5_deg share_worse_than_initial frames""",
}
SETTINGS = "tracker features camera object crop solver runtime"


@pytest.mark.parametrize(("module", "names"), EXACT.items())
def test_a_package_exports_what_it_says(module, names):
    package = import_module(module)
    assert sorted(package.__all__) == sorted(names.split())
    for name in names.split():
        assert getattr(package, name) is not None


@pytest.mark.parametrize(("module", "names"), AT_LEAST.items())
def test_a_module_has_its_public_names(module, names):
    absent = [name for name in names.split() if not hasattr(import_module(module), name)]
    assert absent == []


@pytest.mark.parametrize(
    ("record", "names"), FIELDS.items(), ids=lambda value: getattr(value, "__name__", "")
)
def test_a_record_has_its_fields(record, names):
    assert set(names.split()) <= {field.name for field in dataclasses.fields(record)}


def test_settings_keep_their_sections():
    assert set(SETTINGS.split()) <= set(tracking3d.PipelineConfig.model_fields)


SIGNATURES = Path(__file__).with_name("api_surface.json")
METHODS = {
    "tracking3d.Session": "step refine refine_frame result state_dict load_state_dict",
    "tracking3d.Tracking": "close result",
    "tracking3d.TrackingResult": "export save track_points",
    "tracking3d.results.run_reader.RunReader": "initial_mask mask mesh probability",
}
"""Methods that the documentation calls."""


def surface() -> Iterator[tuple[str, Any]]:
    """All public functions, classes and methods by name."""
    for module, names in {**AT_LEAST, "tracking3d": EXACT["tracking3d"]}.items():
        for name in names.split():
            thing = getattr(import_module(module), name)
            thing = getattr(thing, "_function", thing)  # the tests make some things once, see `made_once`
            if inspect.isfunction(thing) or (inspect.isclass(thing) and not issubclass(thing, str)):
                yield f"{module}.{name}", thing
            for method in METHODS.get(f"{module}.{name}", "").split():
                yield f"{module}.{name}.{method}", getattr(thing, method)


def arguments_of(thing: Any) -> list[list[str]] | None:
    """Name, kind and default of each argument; None of what takes none of its own, such as a protocol."""
    if inspect.isclass(thing) and (getattr(thing, "_is_protocol", False) or hasattr(thing, "model_fields")):
        return None
    try:
        parameters = inspect.signature(thing).parameters.values()
    except ValueError:  # a class of C
        return None
    return [[one.name, one.kind.name, _shown(one.default)] for one in parameters]


def _shown(default: Any) -> str:
    if default is inspect.Parameter.empty:
        return "needed"
    return "a function" if inspect.isfunction(default) else repr(default)


def written_surface() -> str:
    held = {name: found for name, thing in surface() if (found := arguments_of(thing)) is not None}
    return (
        "{\n" + ",\n".join(f"{json.dumps(name)}: {json.dumps(held[name])}" for name in sorted(held)) + "\n}\n"
    )


HELD = json.loads(SIGNATURES.read_text(encoding="utf-8")) if SIGNATURES.is_file() else {}


def test_everything_public_has_its_arguments_held():
    known = {name for name, thing in surface() if arguments_of(thing) is not None}
    assert known - set(HELD) == set(), "new: python tests/test_api_surface.py writes it down"
    assert set(HELD) - known == set(), "taken away"


@pytest.mark.parametrize("name", HELD)
def test_arguments_keep_their_names_order_kinds_and_defaults(name):
    held, now = HELD[name], arguments_of(dict(surface())[name])
    assert now is not None
    by_name = {one[0]: one for one in now}
    assert [by_name.get(one[0]) for one in held] == held
    added = [one for one in now if one[0] not in {old[0] for old in held}]
    assert all(one[2] != "needed" or one[1].startswith("VAR") for one in added), (
        "a new argument has a default"
    )
    in_order = [one[0] for one in now if one[1] != "KEYWORD_ONLY"]
    assert in_order[: sum(one[1] != "KEYWORD_ONLY" for one in held)] == [
        one[0] for one in held if one[1] != "KEYWORD_ONLY"
    ], "those that are given by place keep it"


def test_statuses_are_their_names():
    assert [str(status) for status in tracking3d.Status] == ["tracked", "uncertain", "lost"]


def test_public_names_are_documented():
    for name in set(tracking3d.__all__) - {"__version__"}:
        assert getattr(tracking3d, name).__doc__, name


def test_an_unknown_name_is_told():
    with pytest.raises(AttributeError, match="no attribute 'trakc'"):
        tracking3d.trakc  # noqa: B018


def test_the_package_itself_imports_nothing_heavy():
    code = (
        "import sys, tracking3d; tracking3d.__version__; print(sorted({'torch', 'cv2'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_package_is_typed():
    from importlib.resources import files

    assert (files("tracking3d") / "py.typed").is_file()


if __name__ == "__main__":
    SIGNATURES.write_text(written_surface(), encoding="utf-8")
