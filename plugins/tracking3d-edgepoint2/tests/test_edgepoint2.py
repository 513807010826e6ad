"""The edgepoint2 plug-in: its file is the one that was measured, and matches what is turned in the picture."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import tracking3d_edgepoint2
from tracking3d_edgepoint2 import EdgePoint2Detector

from tracking3d.config.models import PluginChoice
from tracking3d.estimation.online.features.sift import detect, match
from tracking3d.features.keypoint_network import NetworkDetector
from tracking3d.plugins import KEYPOINTS, build_plugin

PACKAGE = Path(tracking3d_edgepoint2.__file__).parent
MEASURED = "46178d71f47321f1c9b05baaa4ef4426ab9eaca6c627ba97dfbf22bd502c5691"


def textured() -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(220, 240)), (0, 0), 2)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)


def test_the_file_is_the_one_that_was_measured_and_its_notice_is_there():
    assert hashlib.sha256((PACKAGE / "t32.onnx").read_bytes()).hexdigest() == MEASURED
    notice = (PACKAGE.parent / "LICENSE-EdgePoint2").read_text(encoding="utf-8")
    assert notice.startswith("MIT License") and "HITCSC-Robotics" in notice


def test_it_is_found_by_its_name_and_gives_what_network_gives_with_the_file():
    found = build_plugin(KEYPOINTS, PluginChoice(name="edgepoint2"))
    assert isinstance(found, EdgePoint2Detector)
    options = NetworkDetector.Options(model=str(PACKAGE / "t32.onnx"))
    image, mask = textured(), np.ones((220, 240), bool)
    ours, same = (one.detect(image, mask, 250, 1.0) for one in (found, NetworkDetector(options)))
    assert len(ours) > 100
    assert ours.descriptor.shape == (len(ours), 32)
    np.testing.assert_array_equal(ours.pixel, same.pixel)
    np.testing.assert_array_equal(ours.descriptor, same.descriptor)


def test_a_picture_that_is_turned_a_little_is_matched():
    detector, image = EdgePoint2Detector.from_options(EdgePoint2Detector.Options()), textured()
    turn = cv2.getRotationMatrix2D((120, 110), 12, 1.05)
    mask = np.zeros((220, 240), bool)
    mask[50:170, 60:180] = True
    a, b = (detect(one, mask, detector=detector) for one in (image, cv2.warpAffine(image, turn, (240, 220))))
    pairs = match(a, b)
    error = b.pixel[pairs[:, 1]] - np.column_stack([a.pixel, np.ones(len(a))])[pairs[:, 0]] @ turn.T
    assert len(pairs) > 60
    assert np.median(np.linalg.norm(error, axis=1)) < 1
