"""Follow a part with a webcam, and say where an arm's gripper should be, in metres, in the axes of the arm's base.

$ python examples/robot_arm.py 0 --box 200,120,180,180 --intrinsics 580,580,320,240 \\
      --hand-eye T_base_cam.json --grasp T_obj_grasp.json --object-size 0.08

Each frame is a line of JSON on the standard output, for whatever moves the arm: ``{"frame": 12, "confidence": 0.83,
"T_base_grasp": [[...], ...]}``, or ``"T_base_grasp": null`` with the reason why nobody should move.

The hand-eye file is a 4 x 4 matrix as JSON that maps the camera's axes (OpenCV's: x right, y down, z forward) to the
base's, in metres, such as cv2.calibrateHandEye gives. The grasp is a 4 x 4 matrix too: the gripper in the object's
axes, which are those of the camera in the first frame with the origin in the object; without it the object's own pose
is given. See docs/how-to/robot-arm.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tracking3d import Frame, FrameEstimate, ObjectModel, Session, Status, load_config
from tracking3d.errors import InputError, Tracking3dError
from tracking3d.frames import SkippedFrame
from tracking3d.results.run_unit import visible_side
from tracking3d.trackers.prompts.prompt import make_prompt, parse_box
from tracking3d.video import open_source

MEASURED_EVERY = 15
"""Sure frames between two measurements of the mesh, which grows as more of the object is seen."""


class Tracking(Protocol):
    """What of a `tracking3d.Session` is used here."""

    def step(self, frame: Frame) -> FrameEstimate:
        """Answer the next frame."""
        ...

    def result(self) -> ObjectModel:
        """The object as far as it is known."""
        ...


@dataclass(frozen=True)
class Grasp:
    """Where the gripper should be.

    Attributes:
        frame: Index of the frame.
        T_base_grasp: ``(4, 4)``, metres; None where nobody should move.
        confidence: Of the pose, in [0, 1].
        reason: Why there is no pose; empty where there is one.
    """

    frame: int
    T_base_grasp: NDArray[np.float64] | None
    confidence: float
    reason: str = ""


def grasps(
    frames: Iterable[Frame | SkippedFrame],
    tracking: Tracking,
    T_base_cam: NDArray[np.float64],
    object_size: float,
    T_obj_grasp: NDArray[np.float64] | None = None,
    steady: int = 3,
) -> Iterator[Grasp]:
    """Follow the object; a pose is given once it has been sure for some frames in a row.

    Args:
        frames: From the first one, in which the object was given, on.
        tracking: Not started yet.
        T_base_cam: Camera to base, ``(4, 4)`` rigid, metres.
        object_size: The longest side of the object, in metres.
        T_obj_grasp: Gripper in the object's axes, ``(4, 4)`` rigid, metres; the object's own pose if None.
        steady: How many frames in a row have to be ``tracked``.
    """
    sure = 0
    metres = 0.0
    for frame in frames:
        if isinstance(frame, SkippedFrame):
            yield Grasp(frame.index, None, 0.0, frame.reason)
            continue
        estimate = tracking.step(frame)
        if estimate.status != Status.TRACKED:
            sure = 0
            yield Grasp(frame.index, None, estimate.confidence, estimate.reason or str(estimate.status))
            continue
        sure += 1
        if sure < steady:
            waiting = f"sure for {sure} of {steady} frames"
            yield Grasp(frame.index, None, estimate.confidence, waiting)
            continue
        if metres == 0 or sure % MEASURED_EVERY == 0:
            metres = object_size / visible_side(tracking.result())
        T_cam_obj = estimate.T_cam_obj.copy()
        T_cam_obj[:3, 3] *= metres
        T_base_obj = T_base_cam @ T_cam_obj
        grasp = T_base_obj if T_obj_grasp is None else T_base_obj @ T_obj_grasp
        yield Grasp(frame.index, grasp, estimate.confidence)


def read_rigid(path: Path) -> NDArray[np.float64]:
    """A rigid 4 x 4 matrix from a JSON file.

    Raises:
        InputError: If there is none in it.
    """
    try:
        T = np.array(json.loads(path.read_text(encoding="utf-8")), dtype=np.float64)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path} cannot be read as a matrix: {error}.") from error
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{path} holds no 4 x 4 matrix; write it as four lists of four numbers.")
    R = T[:3, :3]
    rigid = np.allclose(R.T @ R, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0
    if not rigid or not np.allclose(T[3], (0, 0, 0, 1)):
        raise InputError(f"{path} is no rotation and translation; its last row has to be 0, 0, 0, 1.")
    return T


def session_on(first: Frame | SkippedFrame, box: str, intrinsics: str) -> Session:
    """A session on the part in the first frame.

    Raises:
        InputError: If the frame, the box or the lens cannot be used.
    """
    if isinstance(first, SkippedFrame):
        raise InputError(f"The first frame cannot be read: {first.reason}.")
    try:
        fx, fy, cx, cy = (float(number) for number in intrinsics.split(","))
    except ValueError as error:
        raise InputError(f"--intrinsics {intrinsics} are not four numbers FX,FY,CX,CY in pixels.") from error
    settings = load_config(camera={"intrinsics": (fx, fy, cx, cy)})
    return Session(settings, make_prompt(first, box=parse_box(box)))


def main(arguments: list[str] | None = None) -> int:
    """Print a line for each frame; returns the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("source", help="number of a camera, or a video to try it with")
    parser.add_argument("--box", required=True, metavar="X,Y,W,H", help="the part in the first frame")
    parser.add_argument("--intrinsics", required=True, metavar="FX,FY,CX,CY", help="of the calibrated camera")
    parser.add_argument("--hand-eye", required=True, type=Path, metavar="FILE", help="T_base_cam as JSON")
    parser.add_argument("--grasp", type=Path, metavar="FILE", help="T_obj_grasp as JSON")
    parser.add_argument("--object-size", required=True, type=float, metavar="METRES", help="longest side")
    given = parser.parse_args(arguments)
    try:
        if not 0 < given.object_size < 100:
            raise InputError("--object-size is the part's longest side in metres, above 0.")
        T_base_cam = read_rigid(given.hand_eye)
        T_obj_grasp = None if given.grasp is None else read_rigid(given.grasp)
        frames = iter(open_source(given.source))
        first = next(frames)
        session = session_on(first, given.box, given.intrinsics)
        for grasp in grasps(chain([first], frames), session, T_base_cam, given.object_size, T_obj_grasp):
            T = None if grasp.T_base_grasp is None else grasp.T_base_grasp.round(6).tolist()
            line = {"frame": grasp.frame, "confidence": round(grasp.confidence, 3), "T_base_grasp": T}
            print(json.dumps(line | ({"reason": grasp.reason} if grasp.reason else {})), flush=True)
    except Tracking3dError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
