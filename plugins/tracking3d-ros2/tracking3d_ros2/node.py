"""Messages of ROS 2 around `tracking3d_ros2.tracking`; rclpy and the messages are imported when it runs."""

from __future__ import annotations

from typing import Any

from tracking3d.errors import InputError
from tracking3d.trackers.prompts.prompt import parse_box
from tracking3d_ros2.tracking import Answer, ObjectTracking, rgb_of


class TrackingNode:
    """Topics and parameters of the node.

    Args:
        node: An ``rclpy`` node.
        messages: Classes of messages by name; the node's own if None.
        tracking: What tracks; made of the node's parameters if None.
    """

    def __init__(self, node: Any, messages: dict[str, Any], tracking: ObjectTracking | None = None) -> None:
        self._node, self._messages = node, messages
        self._tracking = tracking or _from_parameters(node)
        types = {
            "pose": "PoseStamped",
            "mask": "Image",
            "mesh": "Marker",
            "diagnostics": "DiagnosticArray",
        }
        self._publishers = {
            name: node.create_publisher(messages[kind], f"~/{name}", 1) for name, kind in types.items()
        }
        # One image waits at most: those that come while one is worked on replace it.
        node.create_subscription(messages["Image"], "image", self._image, messages["newest"])
        node.create_subscription(messages["CameraInfo"], "camera_info", self._camera_info, messages["newest"])
        node.create_subscription(messages["RegionOfInterest"], "~/region", self._region, 1)

    def _camera_info(self, info: Any) -> None:
        self._tracking.lens(list(info.p), list(info.k))

    def _region(self, region: Any) -> None:
        box = float(region.x_offset), float(region.y_offset), float(region.width), float(region.height)
        self._tracking.region(box)

    def _image(self, message: Any) -> None:
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        try:
            image = rgb_of(bytes(message.data), message.height, message.width, message.step, message.encoding)
        except InputError as error:
            self._publish(message.header, Answer(2, str(error)))
            return
        self._publish(message.header, self._tracking.picture(image, stamp))

    def _publish(self, header: Any, answer: Answer) -> None:
        if answer.position is not None:
            pose = self._messages["PoseStamped"]()
            pose.header = header
            _place(pose.pose, answer)
            self._publishers["pose"].publish(pose)
        if answer.mask is not None:
            mask = self._messages["Image"]()
            mask.header, mask.encoding = header, "mono8"
            mask.height, mask.width = answer.mask.shape
            mask.step, mask.data = mask.width, answer.mask.tobytes()
            self._publishers["mask"].publish(mask)
        if answer.mesh is not None:
            self._publishers["mesh"].publish(self._marker(header, answer))
        self._publishers["diagnostics"].publish(self._diagnostics(header, answer))

    def _marker(self, header: Any, answer: Answer) -> Any:
        assert answer.mesh is not None
        marker = self._messages["Marker"]()
        marker.header, marker.ns, marker.id = header, "tracking3d", 0
        marker.type, marker.action = marker.TRIANGLE_LIST, marker.ADD
        marker.scale.x = marker.scale.y = marker.scale.z = 1.0
        marker.color.a = 1.0
        _place(marker.pose, answer)
        point, colour = self._messages["Point"], self._messages["ColorRGBA"]
        marker.points = [point(x=x, y=y, z=z) for x, y, z in answer.mesh.corners.tolist()]
        marker.colors = [colour(r=r, g=g, b=b, a=1.0) for r, g, b in answer.mesh.colours.tolist()]
        return marker

    def _diagnostics(self, header: Any, answer: Answer) -> Any:
        status = self._messages["DiagnosticStatus"]()
        status.name, status.level = "tracking3d: object", bytes([answer.level])
        status.message = answer.message
        pair = self._messages["KeyValue"]
        status.values = [pair(key=key, value=value) for key, value in answer.values.items()]
        array = self._messages["DiagnosticArray"]()
        array.header, array.status = header, [status]
        return array


def _place(pose: Any, answer: Answer) -> None:
    assert answer.position is not None and answer.quaternion is not None
    pose.position.x, pose.position.y, pose.position.z = answer.position.tolist()
    orientation = pose.orientation
    orientation.x, orientation.y, orientation.z, orientation.w = answer.quaternion.tolist()


def _from_parameters(node: Any) -> ObjectTracking:
    defaults = {"box": "", "object_size": 0.0, "mesh_every": 30, "quality": ""}
    given = {name: node.declare_parameter(name, value).value for name, value in defaults.items()}
    box = parse_box(given["box"]) if given["box"] else None
    return ObjectTracking(box, given["object_size"], given["mesh_every"], given["quality"] or None)


def _messages() -> dict[str, Any]:
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import Point, PoseStamped
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import CameraInfo, Image, RegionOfInterest
    from std_msgs.msg import ColorRGBA
    from visualization_msgs.msg import Marker

    classes = [DiagnosticArray, DiagnosticStatus, KeyValue, Point, PoseStamped]
    classes += [CameraInfo, Image, RegionOfInterest, ColorRGBA, Marker]
    newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    return {"newest": newest, **{one.__name__: one for one in classes}}


def main() -> None:
    """Run the node until it is interrupted."""
    try:
        import rclpy
    except ImportError as error:
        raise SystemExit(
            "The node needs ROS 2: source its setup.bash, with a Python that has tracking3d."
        ) from error
    rclpy.init()
    node = rclpy.create_node("tracking3d")
    try:
        TrackingNode(node, _messages())
        rclpy.spin(node)
    except InputError as error:
        node.get_logger().fatal(str(error))
        raise SystemExit(2) from error
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
