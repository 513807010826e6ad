"""A script for After Effects that makes a composition with a camera and a null that moves as the object does.

After Effects' axes are x right, y down, z into the screen, as ours are, and lengths are pixels: a unit of the export is
`PIXELS_PER_UNIT`. The camera is at (0, 0, 0) and looks along z; its zoom is the focal length in pixels. An orientation
is three angles whose matrix is Rx Ry Rz. Frames without a pose have no key. There is no shifted principal point: the
camera's is in the middle.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tracking3d.export.exported_run import ExportedRun

PIXELS_PER_UNIT = 1000.0

_SCRIPT = """\
// tracking3d: run this script with File > Scripts > Run Script File.
(function () {
    var numbers = %s;
    // Names of properties are translated in other languages' versions; these are not.
    function transform(layer, name) {
        return layer.property("ADBE Transform Group").property("ADBE " + name);
    }
    app.beginUndoGroup("tracking3d");
    var comp = app.project.items.addComp(
        numbers.name, numbers.width, numbers.height, 1, numbers.duration, numbers.fps
    );
    var camera = comp.layers.addCamera("tracking3d_camera", [numbers.width / 2, numbers.height / 2]);
    camera.autoOrient = AutoOrientType.NO_AUTO_ORIENT;
    transform(camera, "Position").setValue([0, 0, 0]);
    camera.property("ADBE Camera Options Group").property("ADBE Camera Zoom").setValuesAtTimes(
        numbers.times, numbers.zoom
    );
    var object = comp.layers.addNull(numbers.duration);
    object.name = "tracking3d_object";
    object.threeDLayer = true;
    transform(object, "Anchor Point").setValue([0, 0, 0]);
    transform(object, "Position").setValuesAtTimes(numbers.times, numbers.position);
    transform(object, "Orientation").setValuesAtTimes(numbers.times, numbers.orientation);
    comp.openInViewer();
    app.endUndoGroup();
})();
"""


def write_after_effects(run: ExportedRun, path: Path) -> None:
    """Write the script; time 0 of the composition is frame 0 of the source."""
    R = np.array([one.T_cam_obj[:3, :3] for one in run.poses])
    angles = Rotation.from_matrix(R).as_euler("XYZ", degrees=True)
    numbers = {
        "name": f"tracking3d {run.name}",
        "width": run.camera.width,
        "height": run.camera.height,
        "fps": run.fps,
        "duration": (run.span[-1] + 1) / run.fps,
        "times": [one.index / run.fps for one in run.poses],
        "zoom": [one.camera.fx for one in run.poses],
        "position": [(PIXELS_PER_UNIT * one.T_cam_obj[:3, 3]).tolist() for one in run.poses],
        "orientation": np.mod(angles, 360.0).tolist(),
    }
    path.write_text(_SCRIPT % json.dumps(numbers), encoding="ascii")
