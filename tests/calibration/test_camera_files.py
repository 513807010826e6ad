"""Camera files as OpenCV, ROS, Kalibr and COLMAP write them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.geometry.calibration.camera_files import CalibratedCamera, read_camera, write_camera

COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 {}
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.7e-05]
  distortion_model: {}
  intrinsics: [461.6, 460.2, 363.2, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
ROS = """image_width: 640
image_height: 480
camera_name: narrow
camera_matrix:
  rows: 3
  cols: 3
  data: [500., 0, 320.5, 0, 501., 240.5, 0, 0, 1]
distortion_model: {}
distortion_coefficients:
  rows: 1
  cols: {}
  data: {}
"""


def written(tmp_path, text, name="camera.yaml"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


def test_what_is_written_is_read_by_us_and_by_opencv(tmp_path):
    camera = CalibratedCamera(
        (500.125, 501.5, 320.0, 240.25), "radtan", (-0.3, 0.1, 1e-3, -2e-5, 0.01), (640, 480)
    )
    path = tmp_path / "camera.yaml"
    write_camera(path, camera, {"avg_reprojection_error": 0.25, "views": 12, "board": "7x10"})
    again = read_camera(path)
    assert (again.intrinsics, again.model, again.coefficients, again.size) == (
        camera.intrinsics, camera.model, camera.coefficients, camera.size,
    )  # fmt: skip
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("camera_matrix").mat()[[0, 1], [0, 2]], (500.125, 240.25))
    np.testing.assert_allclose(storage.getNode("distortion_coefficients").mat().ravel(), camera.coefficients)
    assert storage.getNode("views").real() == 12
    storage.release()


def test_what_opencv_writes_is_read(tmp_path):
    path = tmp_path / "camera.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", np.array([[500, 0, 320], [0, 501, 240], [0, 0, 1.0]]))
    storage.write("distortion_coefficients", np.array([[-0.3], [0.1], [0], [0], [0.02]]))
    storage.release()
    camera = read_camera(path)
    assert camera.intrinsics == (500, 501, 320, 240) and camera.size == (640, 480)
    assert camera.coefficients == (-0.3, 0.1, 0, 0, 0.02)


@pytest.mark.parametrize(
    ("line", "intrinsics", "model", "coefficients"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", (500, 500, 319.5, 239.5), "radtan", ()),
        ("PINHOLE 640 480 500 501 320 240", (500, 501, 319.5, 239.5), "radtan", ()),
        ("SIMPLE_RADIAL 640 480 500 320 240 -0.1", (500, 500, 319.5, 239.5), "radtan", (-0.1, 0, 0, 0)),
        ("RADIAL 640 480 500 320 240 -0.1 0.02", (500, 500, 319.5, 239.5), "radtan", (-0.1, 0.02, 0, 0)),
        ("OPENCV 640 480 500 501 320 240 -0.1 0.02 0.003 0.004", (500, 501, 319.5, 239.5), "radtan",
         (-0.1, 0.02, 0.003, 0.004)),
        ("OPENCV_FISHEYE 640 480 500 501 320 240 -0.1 0.02 0.003 0.004", (500, 501, 319.5, 239.5), "fisheye",
         (-0.1, 0.02, 0.003, 0.004)),
        ("FULL_OPENCV 640 480 500 501 320 240 1 2 3 4 5 6 7 8", (500, 501, 319.5, 239.5), "radtan",
         (1, 2, 3, 4, 5, 6, 7, 8)),
    ],
)  # fmt: skip
def test_cameras_of_colmap(tmp_path, line, intrinsics, model, coefficients):
    camera = read_camera(written(tmp_path, COLMAP.format(line), "cameras.txt"))
    assert (camera.intrinsics, camera.model, camera.coefficients) == (intrinsics, model, coefficients)
    assert camera.size == (640, 480)


@pytest.mark.slow
def test_colmap_itself_projects_alike(tmp_path):
    """By pycolmap, in a process of its own."""
    pycolmap = pytest.importorskip("pycolmap")
    from tracking3d.geometry.lens import Lens

    for name, k in (
        ("OPENCV", (-0.2, 0.05, 0.002, -0.001)),
        ("OPENCV_FISHEYE", (0.02, -0.01, 0.004, -0.001)),
    ):
        theirs = pycolmap.Camera(model=name, width=640, height=480, params=[500, 501, 320, 240, *k])
        line = f"{name} 640 480 500 501 320 240 " + " ".join(map(str, k))
        ours = read_camera(written(tmp_path, COLMAP.format(line), "cameras.txt"))
        lens = Lens(ours.model, ours.coefficients, ours.intrinsics, ours.intrinsics, 640, 480)
        rays = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2))
        found = lens.to_picture(rays * (500, 501) + (319.5, 239.5))
        for ray, pixel in zip(rays, found, strict=True):
            np.testing.assert_allclose(theirs.img_from_cam(np.array([*ray, 1.0])), pixel + 0.5, atol=1e-6)


@pytest.mark.parametrize(("name", "model"), [("radtan", "radtan"), ("equidistant", "fisheye")])
def test_a_camchain_of_kalibr(tmp_path, name, model):
    camera = read_camera(written(tmp_path, KALIBR.format(name)))
    assert camera.intrinsics == (461.6, 460.2, 363.2, 248.1) and camera.size == (752, 480)
    assert camera.model == model and camera.coefficients == (-0.28, 0.07, 0.0002, 1.7e-05)


@pytest.mark.parametrize(
    ("name", "data", "model"),
    [("plumb_bob", [-0.3, 0.1, 0, 0, 0], "radtan"), ("equidistant", [0.1, 0, 0, 0], "fisheye"),
     ("rational_polynomial", [-0.3, 0.1, 0, 0, 0, 0.1, 0, 0], "radtan")],
)  # fmt: skip
def test_camera_info_of_ros(tmp_path, name, data, model):
    camera = read_camera(written(tmp_path, ROS.format(name, len(data), data)))
    assert camera.intrinsics == (500, 501, 320.5, 240.5)
    assert (camera.model, camera.coefficients) == (model, tuple(data))


def test_one_of_several_cameras_is_named(tmp_path):
    path = written(tmp_path, KALIBR.format("radtan") + KALIBR.format("equidistant").replace("cam0", "cam1"))
    with pytest.raises(InputError, match=r"several cameras \(cam0, cam1\); choose one, as in .*:cam0"):
        read_camera(path)
    assert read_camera(f"{path}:cam1").model == "fisheye"
    with pytest.raises(InputError, match="has no camera cam7; it has cam0, cam1"):
        read_camera(f"{path}:cam7")


def test_a_camera_of_a_larger_mode_is_scaled(tmp_path):
    camera = read_camera(written(tmp_path, ROS.format("plumb_bob", 0, [])))
    half = camera.for_frames(320, 240)
    assert half.intrinsics == (250, 250.5, 160.0, 120.0)  # the centre of the top-left pixel is (0, 0) in both
    with pytest.raises(InputError, match="another aspect ratio"):
        camera.for_frames(640, 360)


BROKEN = {
    "nothing.yaml": "",
    "list.yaml": "[1, 2]",
    "no_yaml.yaml": "{a: ",
    "tag.yaml": "!!python/object/apply:os.system ['true']",
    "alias.yaml": "a: &a [1]\nb: *a\n",
    "deep.yaml": "[" * 3000,
    "none.yaml": "a: 1",
    "short.yaml": "camera_matrix: [1, 2, 3]",
    "words.yaml": "camera_matrix: [a, b, c, d, e, f, g, h, i]",
    "text.yaml": "camera_matrix: abcdefghi",
    "zero.yaml": "camera_matrix: [0, 0, 0, 0, 0, 0, 0, 0, 1]",
    "nan.yaml": "camera_matrix: [.nan, 0, 0, 0, 1, 0, 0, 0, 1]",
    "many.yaml": f"camera_matrix: [9, 0, 1, 0, 9, 1, 0, 0, 1]\nD: {list(range(1, 20))}",
    "model.yaml": ROS.format("thin_fish", 1, [1]),
    "size.yaml": ROS.format("plumb_bob", 0, []).replace("640", "wide"),
    "kalibr.yaml": KALIBR.format("fov"),
    "omni.yaml": KALIBR.format("radtan").replace("pinhole", "omni"),
    "three.yaml": KALIBR.format("radtan").replace("461.6, ", ""),
    "resolution.yaml": KALIBR.format("radtan").replace("[752, 480]", "752"),
    "cameras.txt": "1 PINHOLE 640",
    "empty.txt": "# nothing\n",
    "unknown.txt": COLMAP.format("FOV 640 480 1 2 3 4 5"),
    "few.txt": COLMAP.format("OPENCV 640 480 1 2 3"),
    "words.txt": COLMAP.format("PINHOLE 640 480 a b c d"),
    "full.txt": COLMAP.format("FULL_OPENCV 640 480 500 501 320 240 1 2 3 4 5"),
    "minus.txt": COLMAP.format("PINHOLE -640 480 500 500 320 240"),
    "binary.yaml": "\0\1\2",
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_camera_file_is_one_sentence_with_its_name(tmp_path, name):
    with pytest.raises(InputError, match=name.replace(".", r"\.")) as error:
        read_camera(written(tmp_path, BROKEN[name], name))
    assert "\n" not in str(error.value)


def test_no_file_and_a_folder(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_camera(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        read_camera(tmp_path)
