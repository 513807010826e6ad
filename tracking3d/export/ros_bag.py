"""A ROS 2 bag, written without ROS.

Topics: ``/tracking3d/pose`` (``geometry_msgs/PoseStamped``), ``/tracking3d/camera_info``
(``sensor_msgs/CameraInfo``) and ``/tf`` (``tf2_msgs/TFMessage``). All are in the frame
``tracking3d_camera_optical``, whose axes are those of ROS's optical frames and ours: x right, y down, z forward.
Stamps count from the start of the source. Frames without a pose have a camera and no pose. Lengths are in metres,
or in the run's unit taken for one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.export.axes import quaternion
from tracking3d.export.exported_run import ExportedRun, PosedFrame
from tracking3d.geometry.camera import Camera

CAMERA_FRAME = "tracking3d_camera_optical"
OBJECT_FRAME = "tracking3d_object"
_NANOSECONDS = 10**9


def write_ros_bag(run: ExportedRun, folder: Path) -> None:
    """Write the bag with SQLite as its storage, which every ROS 2 has."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {
        "/tracking3d/camera_info": "sensor_msgs/msg/CameraInfo",
        "/tracking3d/pose": "geometry_msgs/msg/PoseStamped",
        "/tf": "tf2_msgs/msg/TFMessage",
    }
    posed = {one.index: one for one in run.poses}
    with Writer(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topics = {name: bag.add_connection(name, kind, typestore=store) for name, kind in kinds.items()}
        for index, record in run.records.items():
            seconds = run.seconds(index)
            stamp = round((index / run.fps if seconds is None else seconds) * _NANOSECONDS)
            messages = {"/tracking3d/camera_info": _camera_info(store, run.reader.camera_of(record), stamp)}
            if index in posed:
                messages |= _pose_messages(store, posed[index], stamp)
            for name, message in messages.items():
                bag.write(topics[name], stamp, store.serialize_cdr(message, kinds[name]))


def _header(store: Any, stamp: int) -> Any:
    seconds, nanoseconds = divmod(stamp, _NANOSECONDS)
    time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=CAMERA_FRAME)


def _camera_info(store: Any, camera: Camera, stamp: int) -> Any:
    whole = store.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return store.types["sensor_msgs/msg/CameraInfo"](
        header=_header(store, stamp),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([camera.K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=whole,
    )


def _pose_messages(store: Any, one: PosedFrame, stamp: int) -> dict[str, Any]:
    w, x, y, z = (float(value) for value in quaternion(one.T_cam_obj))
    place = dict(zip("xyz", one.T_cam_obj[:3, 3].tolist(), strict=True))
    geometry = {name: store.types[f"geometry_msgs/msg/{name}"] for name in _GEOMETRY}
    turn = geometry["Quaternion"](x=x, y=y, z=z, w=w)
    header = _header(store, stamp)
    pose = geometry["Pose"](position=geometry["Point"](**place), orientation=turn)
    transform = geometry["TransformStamped"](
        header=header,
        child_frame_id=OBJECT_FRAME,
        transform=geometry["Transform"](translation=geometry["Vector3"](**place), rotation=turn),
    )
    return {
        "/tracking3d/pose": geometry["PoseStamped"](header=header, pose=pose),
        "/tf": store.types["tf2_msgs/msg/TFMessage"](transforms=[transform]),
    }


_GEOMETRY = ("Quaternion", "Point", "Pose", "PoseStamped", "Vector3", "Transform", "TransformStamped")
