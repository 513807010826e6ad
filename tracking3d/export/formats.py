"""All formats, by the names that select them."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.export.exporter import Exporter

if TYPE_CHECKING:
    from tracking3d.export.exported_run import ExportedRun


def _writer(module: str, function: str) -> Callable[[ExportedRun, Path], object]:
    """A function of a module in this package, which is imported when it is called: some need seconds for that."""

    def write(run: ExportedRun, path: Path) -> object:
        return getattr(import_module(f"tracking3d.export.{module}"), function)(run, path)

    return write


write_after_effects = _writer("after_effects", "write_after_effects")
write_animated_glb = _writer("animated_glb", "write_animated_glb")
write_blender = _writer("blender", "write_blender")
write_bop_poses = _writer("bop_poses", "write_bop_poses")
write_coco = _writer("coco", "write_coco")
write_colmap_binary = _writer("colmap", "write_colmap_binary")
write_colmap_text = _writer("colmap", "write_colmap_text")
write_cut_outs = _writer("cut_outs", "write_cut_outs")
write_prores = _writer("cut_outs", "write_prores")
write_vp9 = _writer("cut_outs", "write_vp9")
write_davis = _writer("indexed_masks", "write_davis")
write_youtube_vos = _writer("indexed_masks", "write_youtube_vos")
write_kitti = _writer("kitti", "write_kitti")
write_glb = _writer("model_files", "write_glb")
write_ply = _writer("model_files", "write_ply")
write_stl = _writer("model_files", "write_stl")
write_nerfstudio = _writer("nerfstudio", "write_nerfstudio")
write_nuke = _writer("nuke", "write_nuke")
write_points_csv = _writer("point_tracks", "write_points_csv")
write_tapvid = _writer("point_tracks", "write_tapvid")
write_csv = _writer("pose_table", "write_csv")
write_parquet = _writer("pose_table", "write_parquet")
write_probabilities = _writer("probability_pictures", "write_probabilities")
write_probabilities_16 = _writer("probability_pictures", "write_probabilities_16")
write_rerun = _writer("rerun_recording", "write_rerun")
write_mcap = _writer("ros_bag", "write_mcap")
write_ros_bag = _writer("ros_bag", "write_ros_bag")
write_tum = _writer("tum", "write_tum")
write_usdz = _writer("usdz", "write_usdz")
write_vot = _writer("vot_masks", "write_vot")

_LENGTHS = frozenset({"object_size"})
_TIMED = _LENGTHS | {"fps"}
_SURFACE = _LENGTHS | {"unseen"}
_PICTURES = frozenset({"source"})
_RECORDING = _TIMED | _PICTURES | {"start_time", "compressed_images"}
_TRAINING = _LENGTHS | _PICTURES | {"cut_out", "images"}
_POINTS = frozenset({"frame", "xy"})
_MASKS = frozenset({"undistorted"})

_ALL = (
    Exporter(
        "tum",
        "poses",
        "trajectory in the TUM format",
        write_tum,
        ".txt",
        "{run}_tum",
        options=_TIMED | {"of"},
    ),
    Exporter("kitti", "poses", "poses, calibration and times of KITTI", write_kitti, options=_TIMED | {"of"}),
    Exporter("csv", "poses", "table of poses", write_csv, ".csv", options=_TIMED),
    Exporter(
        "parquet",
        "poses",
        "table of poses as Parquet",
        write_parquet,
        ".parquet",
        options=_TIMED,
        modules=("pyarrow",),
        extra="export",
    ),
    Exporter(
        "bop",
        "poses",
        "results of the BOP Challenge",
        write_bop_poses,
        ".csv",
        "tracking3d_{letters}-test",
        options=_LENGTHS,
    ),
    Exporter(
        "ros-bag",
        "poses",
        "ROS 2 bag: poses, camera, TF, images",
        write_ros_bag,
        options=_RECORDING,
        modules=("rosbags",),
        extra="ros",
    ),
    Exporter(
        "mcap",
        "poses",
        "the same as one MCAP file",
        write_mcap,
        ".mcap",
        options=_RECORDING,
        modules=("rosbags",),
        extra="ros",
    ),
    Exporter(
        "colmap", "cameras", "COLMAP model as text, images, masks", write_colmap_text, options=_TRAINING
    ),
    Exporter(
        "colmap-binary",
        "cameras",
        "COLMAP model, binary, images, masks",
        write_colmap_binary,
        options=_TRAINING,
    ),
    Exporter("nerfstudio", "cameras", "transforms.json, images, masks", write_nerfstudio, options=_TRAINING),
    Exporter("davis", "masks", "indexed PNG as in DAVIS", write_davis, options=_MASKS),
    Exporter(
        "youtube-vos", "masks", "indexed PNG and meta.json of YouTube-VOS", write_youtube_vos, options=_MASKS
    ),
    Exporter(
        "coco", "masks", "COCO's JSON, run-length encoded", write_coco, ".json", "{run}_coco", options=_MASKS
    ),
    Exporter("vot", "masks", "regions of the VOT toolkit", write_vot, ".txt", "{run}_vot", options=_MASKS),
    Exporter("cut-outs", "masks", "the object as PNG with alpha", write_cut_outs, options=_PICTURES | _MASKS),
    Exporter(
        "vp9",
        "masks",
        "the object as WebM with alpha",
        write_vp9,
        ".webm",
        options=_PICTURES | _MASKS | {"fps"},
    ),
    Exporter(
        "prores",
        "masks",
        "the object as ProRes 4444 with alpha",
        write_prores,
        ".mov",
        options=_PICTURES | _MASKS | {"fps"},
    ),
    Exporter(
        "probabilities",
        "probabilities",
        "object probability per pixel, grey PNG",
        write_probabilities,
        options=_MASKS,
    ),
    Exporter(
        "probabilities-16",
        "probabilities",
        "object probability per pixel, 16-bit PNG",
        write_probabilities_16,
        options=_MASKS,
    ),
    Exporter(
        "tapvid",
        "points",
        "point tracks as TAP-Vid's arrays",
        write_tapvid,
        ".npz",
        "{run}_tapvid",
        options=_POINTS,
    ),
    Exporter(
        "points-csv",
        "points",
        "point tracks as a table",
        write_points_csv,
        ".csv",
        "{run}_points",
        options=_POINTS,
    ),
    Exporter("glb", "model", "textured mesh, y up", write_glb, ".glb", options=_SURFACE),
    Exporter("ply", "model", "mesh with colours, object coordinates", write_ply, ".ply", options=_SURFACE),
    Exporter("stl", "model", "mesh without colours, object coordinates", write_stl, ".stl", options=_SURFACE),
    Exporter(
        "animated-glb",
        "scene",
        "animated object in front of the camera",
        write_animated_glb,
        ".glb",
        "{run}_animated",
        options=_TIMED | _SURFACE,
    ),
    Exporter(
        "usdz",
        "scene",
        "animated object as USDZ",
        write_usdz,
        ".usdz",
        options=_TIMED | _SURFACE,
        modules=("pxr",),
        extra="usd",
    ),
    Exporter(
        "blender", "scene", "Python script that builds the scene", write_blender, options=_TIMED | _PICTURES
    ),
    Exporter(
        "after-effects", "scene", "script with camera and null", write_after_effects, ".jsx", options=_TIMED
    ),
    Exporter("nuke", "scene", "camera and axis as .chan, mesh as OBJ", write_nuke, options=_SURFACE),
    Exporter(
        "rerun",
        "scene",
        "recording with images, masks, mesh and poses",
        write_rerun,
        ".rrd",
        options=_TIMED | _PICTURES | {"images"},
        modules=("rerun",),
        extra="rerun",
    ),
)

FORMATS = {exporter.name: exporter for exporter in _ALL}
