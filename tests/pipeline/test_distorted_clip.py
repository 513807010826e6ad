"""A clip that was drawn through a lens is tracked about as well as the same clip without."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.geometry.lens import Lens, _picture_to_pinhole
from tracking3d.pipeline.record import record
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.video import open_source

K = (-0.28, 0.08, 0.001, -0.001)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / (a | b).sum()


@pytest.mark.slow
def test_masks_are_right_in_the_pictures_as_they_were_taken(tmp_path):
    clip = synthesize(SyntheticSpec(frames=8, size=(320, 240), degrees_per_frame=4))
    true = clip.camera
    pinhole = (true.fx, true.fy, true.cx, true.cy)
    taken = (1.15 * true.fx, 1.15 * true.fy, true.cx, true.cy)
    lens = Lens("radtan", K, taken, pinhole, 320, 240)
    images = [cv2.remap(image, *_picture_to_pinhole(lens), cv2.INTER_CUBIC) for image in clip.images]
    masks = [lens.mask_to_picture(mask) for mask in clip.masks]
    means, off = {}, {}
    for name, pictures, truth, camera in (
        ("plain", clip.images, clip.masks, {"intrinsics": pinhole}),
        ("bent", images, masks, {"intrinsics": taken, "distortion": K}),
    ):
        np.savez(tmp_path / f"{name}.npz", np.stack(truth))
        tracker = {"name": "precomputed", "path": str(tmp_path / f"{name}.npz")}
        config = load_config(None, camera=camera, tracker=tracker)
        record(open_source(pictures), config, tmp_path / name)
        run = RunReader(tmp_path / name)
        assert [one.status.value for one in run.frames] == ["tracked"] * 8
        means[name] = np.mean([iou(run.mask(index), truth[index]) for index in range(8)])
        turned = [one.T_cam_obj[:3, :3] @ run.frames[0].T_cam_obj[:3, :3].T for one in run.frames]
        expected = [T[:3, :3] @ clip.T_cam_obj[0][:3, :3].T for T in clip.T_cam_obj]
        angles = [
            np.arccos(np.clip((np.trace(a @ b.T) - 1) / 2, -1, 1))
            for a, b in zip(turned, expected, strict=True)
        ]
        off[name] = np.degrees(max(angles))
    assert means["bent"] > means["plain"] - 0.02 and means["bent"] > 0.95
    assert off["bent"] < off["plain"] + 1 and off["bent"] < 5
