"""A ROS 2 bag, written without ROS, with SQLite or MCAP as its storage.

Topics: ``/tracking3d/pose`` (``geometry_msgs/PoseStamped``), ``/tracking3d/camera_info``
(``sensor_msgs/CameraInfo``), ``/tf`` (``tf2_msgs/TFMessage``) and, if asked for, ``/tracking3d/image/compressed``
(``sensor_msgs/CompressedImage``, as the pinhole camera sees them). All are in the frame
``tracking3d_camera_optical``, whose axes are those of ROS's optical frames and ours: x right, y down, z forward.
Stamps begin with the time at which the video was recorded, or with `START`: to ROS a stamp of 0 means that there is
none. Frames without a pose have a camera and no pose. Lengths are in metres, or in the run's unit taken for one.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tracking3d.errors import InputError
from tracking3d.export.axes import quaternion
from tracking3d.export.exported_run import ExportedRun, PosedFrame
from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import places_of
from tracking3d.video.recording_time import recording_time

CAMERA_FRAME = "tracking3d_camera_optical"
OBJECT_FRAME = "tracking3d_object"
START = 1.0
"""Seconds from 1970 to the start of a video that does not say when it was recorded."""
_NANOSECONDS = 10**9
_JPEG_QUALITY = 90
_KINDS = {
    "/tracking3d/camera_info": "sensor_msgs/msg/CameraInfo",
    "/tracking3d/pose": "geometry_msgs/msg/PoseStamped",
    "/tf": "tf2_msgs/msg/TFMessage",
}
_IMAGES = {"/tracking3d/image/compressed": "sensor_msgs/msg/CompressedImage"}


def write_ros_bag(run: ExportedRun, folder: Path) -> None:
    """Write the bag with SQLite as its storage, which every ROS 2 has."""
    _write_bag(run, folder, "SQLITE3")


def write_mcap(run: ExportedRun, path: Path) -> None:
    """Write the bag as one MCAP file, without the ``metadata.yaml`` of a bag."""
    bag = path.parent / "bag"
    _write_bag(run, bag, "MCAP")
    (bag / f"{bag.name}.mcap").replace(path)


def _write_bag(run: ExportedRun, folder: Path, storage: str) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = _KINDS | (_IMAGES if run.options.compressed_images else {})
    posed, start = {one.index: one for one in run.poses}, start_time(run)
    with Writer(folder, version=8, storage_plugin=StoragePlugin[storage]) as bag:
        topics = {name: bag.add_connection(name, kind, typestore=store) for name, kind in kinds.items()}
        for record, image in _with_images(run):
            seconds = run.seconds(record.index)
            seconds = record.index / run.fps if seconds is None else seconds
            stamp = round(start * _NANOSECONDS) + round(seconds * _NANOSECONDS)
            messages = {"/tracking3d/camera_info": _camera_info(store, run.reader.camera_of(record), stamp)}
            if record.index in posed:
                messages |= _pose_messages(store, posed[record.index], stamp)
            if image is not None:
                messages["/tracking3d/image/compressed"] = _compressed_image(store, image, stamp)
            for name, message in messages.items():
                bag.write(topics[name], stamp, store.serialize_cdr(message, kinds[name]))


def start_time(run: ExportedRun) -> float:
    """Seconds from 1970 to the start of the video."""
    if run.options.start_time is not None:
        return run.options.start_time
    source = run.options.source or run.reader.description.get("source")
    places = places_of(source, run.reader.folder) if isinstance(source, str) else []
    recorded = next((time for place in places if (time := recording_time(place)) is not None), None)
    return recorded if recorded is not None and recorded > 0 else START


def _with_images(run: ExportedRun) -> Iterator[tuple[FrameRecord, Image | None]]:
    """The records, each with its image if images were asked for.

    Raises:
        InputError: The video is not there, is another one, or lacks a frame of the run.
    """
    images = run.pinhole_pictures() if run.options.compressed_images else None
    for index, record in run.records.items():
        if images is None:
            yield record, None
            continue
        frame = next((frame for frame in images if frame.index == index), None)
        if frame is None:
            raise InputError(
                f"The video of the run {run.reader.folder} has no frame {index}; give the whole video."
            )
        yield record, frame.image


def _compressed_image(store: Any, image: Image, stamp: int) -> Any:
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), options)[1]
    return store.types["sensor_msgs/msg/CompressedImage"](
        header=_header(store, stamp), format="jpeg", data=data.ravel()
    )


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
