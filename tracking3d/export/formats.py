"""All formats, by the names that select them."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.export.exporter import Exporter

if TYPE_CHECKING:
    from tracking3d.export.exported_run import ExportedRun


def _format(
    name: str,
    kind: str,
    writes: str,
    writer: str,
    suffix: str,
    options: frozenset[str],
    file_name: str = "",
    module: str = "",
    extra: str = "",
) -> Exporter:
    """A format; its writer, ``module.function`` in this package, is imported when it is called: some need seconds."""

    def write(run: ExportedRun, path: Path) -> object:
        place, _, function = writer.partition(".")
        return getattr(import_module(f"tracking3d.export.{place}"), function)(run, path)

    modules = (module,) if module else ()
    return Exporter(name, kind, writes, write, suffix, file_name, options, modules, extra)


_LENGTHS = frozenset({"object_size"})
_TIMED = _LENGTHS | {"fps"}
_POSES = _TIMED | {"of"}
_SURFACE = _LENGTHS | {"unseen"}
_PICTURES = frozenset({"source"})
_RECORDING = _TIMED | _PICTURES | {"start_time", "compressed_images"}
_TRAINING = _LENGTHS | _PICTURES | {"cut_out", "images"}
_POINTS = frozenset({"frame", "xy"})
_MASKS = frozenset({"undistorted"})
_VIDEO = _PICTURES | _MASKS | {"fps"}
_ROS = {"module": "rosbags", "extra": "ros"}

# fmt: off
_ALL = (
    _format("tum", "poses", "trajectory in the TUM format", "tum.write_tum", ".txt", _POSES, "{run}_tum"),
    _format("kitti", "poses", "poses, calibration and times of KITTI", "kitti.write_kitti", "", _POSES),
    _format("csv", "poses", "table of poses", "pose_table.write_csv", ".csv", _TIMED),
    _format("parquet", "poses", "table of poses as Parquet", "pose_table.write_parquet", ".parquet", _TIMED,
            module="pyarrow", extra="export"),
    _format("bop", "poses", "results of the BOP Challenge", "bop_poses.write_bop_poses", ".csv", _LENGTHS,
            "tracking3d_{letters}-test"),
    _format("ros-bag", "poses", "ROS 2 bag: poses, camera, TF, images", "ros_bag.write_ros_bag", "", _RECORDING,
            **_ROS),
    _format("mcap", "poses", "the same as one MCAP file", "ros_bag.write_mcap", ".mcap", _RECORDING, **_ROS),
    _format("colmap", "cameras", "COLMAP model as text, images, masks", "colmap.write_colmap_text", "", _TRAINING),
    _format("colmap-binary", "cameras", "COLMAP model, binary, images, masks", "colmap.write_colmap_binary", "",
            _TRAINING),
    _format("nerfstudio", "cameras", "transforms.json, images, masks", "nerfstudio.write_nerfstudio", "", _TRAINING),
    _format("davis", "masks", "indexed PNG as in DAVIS", "indexed_masks.write_davis", "", _MASKS),
    _format("youtube-vos", "masks", "indexed PNG and meta.json of YouTube-VOS", "indexed_masks.write_youtube_vos", "",
            _MASKS),
    _format("coco", "masks", "COCO's JSON, run-length encoded", "coco.write_coco", ".json", _MASKS, "{run}_coco"),
    _format("vot", "masks", "regions of the VOT toolkit", "vot_masks.write_vot", ".txt", _MASKS, "{run}_vot"),
    _format("cut-outs", "masks", "the object as PNG with alpha", "cut_outs.write_cut_outs", "", _PICTURES | _MASKS),
    _format("vp9", "masks", "the object as WebM with alpha", "cut_outs.write_vp9", ".webm", _VIDEO),
    _format("prores", "masks", "the object as ProRes 4444 with alpha", "cut_outs.write_prores", ".mov", _VIDEO),
    _format("probabilities", "probabilities", "object probability per pixel, grey PNG",
            "probability_pictures.write_probabilities", "", _MASKS),
    _format("probabilities-16", "probabilities", "object probability per pixel, 16-bit PNG",
            "probability_pictures.write_probabilities_16", "", _MASKS),
    _format("tapvid", "points", "point tracks as TAP-Vid's arrays", "point_tracks.write_tapvid", ".npz", _POINTS,
            "{run}_tapvid"),
    _format("points-csv", "points", "point tracks as a table", "point_tracks.write_points_csv", ".csv", _POINTS,
            "{run}_points"),
    _format("glb", "model", "textured mesh, y up", "model_files.write_glb", ".glb", _SURFACE),
    _format("ply", "model", "mesh with colours, object coordinates", "model_files.write_ply", ".ply", _SURFACE),
    _format("stl", "model", "mesh without colours, object coordinates", "model_files.write_stl", ".stl", _SURFACE),
    _format("animated-glb", "scene", "animated object in front of the camera", "animated_glb.write_animated_glb",
            ".glb", _TIMED | _SURFACE, "{run}_animated"),
    _format("usdz", "scene", "animated object as USDZ", "usdz.write_usdz", ".usdz", _TIMED | _SURFACE,
            module="pxr", extra="usd"),
    _format("blender", "scene", "Python script that builds the scene", "blender.write_blender", "",
            _TIMED | _PICTURES),
    _format("after-effects", "scene", "script with camera and null", "after_effects.write_after_effects", ".jsx",
            _TIMED),
    _format("nuke", "scene", "camera and axis as .chan, mesh as OBJ", "nuke.write_nuke", "", _SURFACE),
    _format("rerun", "scene", "recording with images, masks, mesh and poses", "rerun_recording.write_rerun", ".rrd",
            _TIMED | _PICTURES | {"images"}, module="rerun", extra="rerun"),
)
# fmt: on

FORMATS = {exporter.name: exporter for exporter in _ALL}
