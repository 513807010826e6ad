"""Build in Blender what ``scene.json`` beside this file describes: a tracked object moving before the camera.

Run it by ``blender --python scene.py``, or open it in Blender's text editor and run it there.
"""

import json
from pathlib import Path

import bpy
from mathutils import Matrix


def build(folder: Path) -> None:
    """Make a scene of its own with object, camera and light, and show it."""
    numbers = json.loads((folder / "scene.json").read_text(encoding="ascii"))
    scene = bpy.data.scenes.new("tracking3d")
    prepare(scene, numbers)
    scene.camera = add_camera(scene, numbers)
    add_object(scene, numbers, folder)
    add_light(scene)
    scene.frame_set(numbers["first"])
    if bpy.context.window is not None:
        bpy.context.window.scene = scene


def prepare(scene, numbers):
    """Set what the video has: its size, rate and frames."""
    render = scene.render
    render.resolution_x, render.resolution_y = numbers["width"], numbers["height"]
    render.resolution_percentage = 100
    aspect = numbers["pixel_aspect"]
    render.pixel_aspect_x, render.pixel_aspect_y = max(1 / aspect, 1.0), max(aspect, 1.0)
    render.fps = max(round(numbers["fps"]), 1)
    render.fps_base = render.fps / numbers["fps"]
    scene.frame_start, scene.frame_end = numbers["first"], numbers["last"]


def add_camera(scene, numbers):
    """Add a camera at the origin that looks along y, with the lens of every frame."""
    data = bpy.data.cameras.new("tracking3d_camera")
    data.sensor_fit, data.sensor_width = "HORIZONTAL", numbers["sensor_width"]
    for pose in numbers["poses"]:
        for name in ("lens", "shift_x", "shift_y"):
            setattr(data, name, pose[name])
            data.keyframe_insert(name, frame=pose["frame"])
    camera = bpy.data.objects.new("tracking3d_camera", data)
    camera.matrix_world = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
    scene.collection.objects.link(camera)
    if numbers["video"] and Path(numbers["video"]).is_file():
        clip = bpy.data.movieclips.load(numbers["video"])
        clip.frame_start = 0
        data.show_background_images = True
        background = data.background_images.new()
        background.source, background.clip, background.alpha = "MOVIE_CLIP", clip, 1.0
    return camera


def add_object(scene, numbers, folder):
    """Add the textured mesh, its pose in every frame, and hide it where it has none."""
    mesh = bpy.data.meshes.new("tracking3d_object")
    mesh.from_pydata(numbers["vertices"], [], numbers["faces"])
    layer = mesh.uv_layers.new(name="UVMap")
    corners = (uv for face in numbers["face_uvs"] for uv in face)
    for corner, uv in zip(layer.data, corners, strict=True):
        corner.uv = uv
    mesh.materials.append(textured_material(folder / numbers["texture"]))
    thing = bpy.data.objects.new("tracking3d_object", mesh)
    scene.collection.objects.link(thing)
    thing.rotation_mode = "QUATERNION"
    before = None
    for pose in numbers["poses"]:
        thing.matrix_world = Matrix(pose["matrix_world"])
        turn = thing.rotation_quaternion.copy()
        if before is not None:
            turn.make_compatible(before)
        before = thing.rotation_quaternion = turn
        thing.keyframe_insert("location", frame=pose["frame"])
        thing.keyframe_insert("rotation_quaternion", frame=pose["frame"])
    if numbers["hidden"]:
        hidden = set(numbers["hidden"])
        for frame in range(numbers["first"], numbers["last"] + 1):
            thing.hide_render = thing.hide_viewport = frame in hidden
            thing.keyframe_insert("hide_render", frame=frame)
            thing.keyframe_insert("hide_viewport", frame=frame)


def add_light(scene):
    """Add a sun that shines the way the camera looks."""
    light = bpy.data.objects.new("tracking3d_light", bpy.data.lights.new("tracking3d_light", "SUN"))
    light.matrix_world = scene.camera.matrix_world
    light.data.energy = 3.0
    scene.collection.objects.link(light)


def textured_material(path):
    """A material with the colours of the picture at ``path``."""
    material = bpy.data.materials.new("tracking3d_texture")
    if bpy.app.version < (5, 0):  # later ones always do
        material.use_nodes = True
    nodes = material.node_tree.nodes
    surface = nodes.get("Principled BSDF")
    surface.inputs["Roughness"].default_value = 1.0
    picture = nodes.new("ShaderNodeTexImage")
    picture.image = bpy.data.images.load(str(path))
    material.node_tree.links.new(picture.outputs["Color"], surface.inputs["Base Color"])
    return material


def own_folder() -> Path:
    """Where this file is, whether Blender was started with it or has it open as a text."""
    text = getattr(getattr(bpy.context, "space_data", None), "text", None)
    return Path(bpy.path.abspath(text.filepath) if text and text.filepath else __file__).resolve().parent


if __name__ == "__main__":
    build(own_folder())
