"""All formats, by the names that select them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.errors import InputError
from tracking3d.export.options import ExportOptions

if TYPE_CHECKING:
    from tracking3d.export.exported_run import ExportedRun

ANYWHERE = frozenset({"answers"})
"""Options of all formats."""


@dataclass(frozen=True)
class Exporter:
    """One format."""

    name: str  # what selects it
    kind: str  # what it is about: poses, cameras, masks, probabilities, points, model or scene
    writes: str  # what it writes, in a few words
    writer: str  # module in this package and function that writes a run to a path that does not exist yet
    suffix: str  # suffix of the file; empty if a folder is written
    # names of those `ExportOptions` that it has a use for, besides `ANYWHERE`
    options: frozenset[str]
    # Name of the file without its suffix in the folder of exports: {run} stands for the name of the run,
    # {letters} for the letters and digits of that name. A folder has the format's name.
    file_name: str = "{run}"
    module: str = ""  # what has to be importable, besides what tracking3d always needs
    extra: str = ""  # what brings it: the name of an extra of this package

    def write(self, run: ExportedRun, path: Path) -> None:
        """Write a run; the module is imported now, since some need seconds for that."""
        module, _, function = self.writer.partition(".")
        getattr(import_module(f"tracking3d.export.{module}"), function)(run, path)

    def default_name(self, run: ExportedRun) -> str:
        """The name of the file or folder in the folder of exports of a run."""
        if not self.suffix:
            return self.name
        return self.file_name.format(run=run.title, letters=run.name.replace("-", "")) + self.suffix

    @property
    def is_available(self) -> bool:
        """Whether what it needs is installed."""
        return not self.module or find_spec(self.module) is not None

    def check_available(self) -> None:
        """Make sure that what it needs is installed.

        Raises:
            InputError: If not; says what to install.
        """
        if not self.is_available:
            raise InputError(
                f"The format {self.name} needs {self.module}, which is not installed; run "
                f"`pip install 'tracking3d[{self.extra}]'`."
            )

    def check_options(self, options: ExportOptions, named: dict[str, str]) -> None:
        """Make sure that no option was given that would have no effect.

        Args:
            options: What was asked.
            named: What sentences call each option.

        Raises:
            InputError: If one was.
        """
        defaults = ExportOptions()
        known = self.options | ANYWHERE
        for option, label in named.items():
            if option not in known and getattr(options, option) != getattr(defaults, option):
                raise InputError(f"The format {self.name} does not use {label}; leave it out.")


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
    Exporter("tum", "poses", "trajectory in the TUM format", "tum.write_tum", ".txt", _POSES, "{run}_tum"),
    Exporter("kitti", "poses", "poses, calibration and times of KITTI", "kitti.write_kitti", "", _POSES),
    Exporter("csv", "poses", "table of poses", "pose_table.write_csv", ".csv", _TIMED),
    Exporter("parquet", "poses", "table of poses as Parquet", "pose_table.write_parquet", ".parquet", _TIMED,
             module="pyarrow", extra="export"),
    Exporter("bop", "poses", "results of the BOP Challenge", "bop_poses.write_bop_poses", ".csv", _LENGTHS,
             "tracking3d_{letters}-test"),
    Exporter("ros-bag", "poses", "ROS 2 bag: poses, camera, TF, images", "ros_bag.write_ros_bag", "", _RECORDING,
             **_ROS),
    Exporter("mcap", "poses", "the same as one MCAP file", "ros_bag.write_mcap", ".mcap", _RECORDING, **_ROS),
    Exporter("colmap", "cameras", "COLMAP model as text, images, masks", "colmap.write_colmap_text", "", _TRAINING),
    Exporter("colmap-binary", "cameras", "COLMAP model, binary, images, masks", "colmap.write_colmap_binary", "",
             _TRAINING),
    Exporter("nerfstudio", "cameras", "transforms.json, images, masks", "nerfstudio.write_nerfstudio", "", _TRAINING),
    Exporter("davis", "masks", "indexed PNG as in DAVIS", "indexed_masks.write_davis", "", _MASKS),
    Exporter("youtube-vos", "masks", "indexed PNG and meta.json of YouTube-VOS", "indexed_masks.write_youtube_vos", "",
             _MASKS),
    Exporter("coco", "masks", "COCO's JSON, run-length encoded", "coco.write_coco", ".json", _MASKS, "{run}_coco"),
    Exporter("vot", "masks", "regions of the VOT toolkit", "vot_masks.write_vot", ".txt", _MASKS, "{run}_vot"),
    Exporter("cut-outs", "masks", "the object as PNG with alpha", "cut_outs.write_cut_outs", "", _PICTURES | _MASKS),
    Exporter("vp9", "masks", "the object as WebM with alpha", "cut_outs.write_vp9", ".webm", _VIDEO),
    Exporter("prores", "masks", "the object as ProRes 4444 with alpha", "cut_outs.write_prores", ".mov", _VIDEO),
    Exporter("probabilities", "probabilities", "object probability per pixel, grey PNG",
             "probability_pictures.write_probabilities", "", _MASKS),
    Exporter("probabilities-16", "probabilities", "object probability per pixel, 16-bit PNG",
             "probability_pictures.write_probabilities_16", "", _MASKS),
    Exporter("tapvid", "points", "point tracks as TAP-Vid's arrays", "point_tracks.write_tapvid", ".npz", _POINTS,
             "{run}_tapvid"),
    Exporter("points-csv", "points", "point tracks as a table", "point_tracks.write_points_csv", ".csv", _POINTS,
             "{run}_points"),
    Exporter("glb", "model", "textured mesh, y up", "model_files.write_glb", ".glb", _SURFACE),
    Exporter("ply", "model", "mesh with colours, object coordinates", "model_files.write_ply", ".ply", _SURFACE),
    Exporter("stl", "model", "mesh without colours, object coordinates", "model_files.write_stl", ".stl", _SURFACE),
    Exporter("animated-glb", "scene", "animated object in front of the camera", "animated_glb.write_animated_glb",
             ".glb", _TIMED | _SURFACE, "{run}_animated"),
    Exporter("usdz", "scene", "animated object as USDZ", "usdz.write_usdz", ".usdz", _TIMED | _SURFACE,
             module="pxr", extra="usd"),
    Exporter("blender", "scene", "Python script that builds the scene", "blender.write_blender", "",
             _TIMED | _PICTURES),
    Exporter("after-effects", "scene", "script with camera and null", "after_effects.write_after_effects", ".jsx",
             _TIMED),
    Exporter("nuke", "scene", "camera and axis as .chan, mesh as OBJ", "nuke.write_nuke", "", _SURFACE),
    Exporter("rerun", "scene", "recording with images, masks, mesh and poses", "rerun_recording.write_rerun", ".rrd",
             _TIMED | _PICTURES | {"images"}, module="rerun", extra="rerun"),
)
# fmt: on

FORMATS = {exporter.name: exporter for exporter in _ALL}
