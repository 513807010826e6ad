"""What colcon installs beside the package: where ROS looks for packages, launch files and programs."""

from setuptools import setup

setup(
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/tracking3d_ros2"]),
        ("share/tracking3d_ros2", ["package.xml"]),
        ("share/tracking3d_ros2/launch", ["launch/tracking3d.launch.py"]),
    ],
)
