"""Start the node on a camera: ros2 launch tracking3d_ros2 tracking3d.launch.py image:=/camera/image_rect ..."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """The node, with its topics and parameters as arguments."""
    arguments = [
        DeclareLaunchArgument("image", default_value="/camera/image_rect", description="sensor_msgs/Image"),
        DeclareLaunchArgument("camera_info", default_value="/camera/camera_info", description="its lens"),
        DeclareLaunchArgument("box", default_value="", description="x,y,width,height in the first image"),
        DeclareLaunchArgument("object_size", default_value="0.0", description="longest side in metres"),
    ]
    node = Node(
        package="tracking3d_ros2",
        executable="tracking3d_node",
        name="tracking3d",
        output="screen",
        remappings=[
            ("image", LaunchConfiguration("image")),
            ("camera_info", LaunchConfiguration("camera_info")),
        ],
        parameters=[
            {"box": LaunchConfiguration("box"), "object_size": LaunchConfiguration("object_size")},
        ],
    )
    return LaunchDescription([*arguments, node])
