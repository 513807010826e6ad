"""The TraX server answers what it is asked; ``trax`` itself is stood in for."""

from __future__ import annotations

import sys
from collections import namedtuple
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from sample_objects import QUICK, sample_clip, write_frames

from tracking3d_bench.evaluation.metrics import mask_iou
from tracking3d_bench.vot.trax_server import main

Request = namedtuple("Request", ["type", "image", "objects"])


class Rectangle:
    type = "rectangle"

    def __init__(self, *bounds):
        self._bounds = bounds

    def bounds(self):
        return self._bounds


class Mask:
    type = "mask"

    def __init__(self, array, offset=(0, 0)):
        self._array, self._offset = array, offset

    @classmethod
    def create(cls, array):
        assert array.dtype == np.uint8 and array.flags.c_contiguous  # the library copies its bytes
        return cls(array)

    def array(self):
        return self._array

    def offset(self):
        return self._offset


class Polygon(list):
    type = "polygon"


@pytest.fixture
def serve(monkeypatch):
    """Runs the server on requests; what it answered, and the reason it gave for leaving."""

    def run(*requests, arguments=("--set", QUICK)):
        told = SimpleNamespace(answers=[], reason=None, options=None)

        class Server:
            def __init__(self, regions, images, **options):
                told.options = regions, images, options
                self._requests = iter([*requests, Request("quit", None, None)])

            __enter__ = lambda self: self  # noqa: E731
            __exit__ = lambda self, *_: None  # noqa: E731

            def wait(self):
                return next(self._requests)

            def status(self, objects):
                told.answers.append(objects)

            def quit(self, reason=None):
                told.reason = reason

        trax, region = ModuleType("trax"), ModuleType("trax.region")
        trax.Server, trax.Image = Server, SimpleNamespace(PATH="path")
        trax.Region = SimpleNamespace(MASK="mask", RECTANGLE="rectangle", POLYGON="polygon")
        trax.TraxStatus = SimpleNamespace(INITIALIZE="initialize", FRAME="frame")
        region.Mask = Mask
        monkeypatch.setitem(sys.modules, "trax", trax)
        monkeypatch.setitem(sys.modules, "trax.region", region)
        main(list(arguments))
        return told

    return run


@pytest.fixture(scope="module")
def clip():
    return sample_clip()


@pytest.fixture(scope="module")
def images(clip, tmp_path_factory):
    paths = write_frames(tmp_path_factory.mktemp("frames"), clip)
    return [{"color": SimpleNamespace(path=lambda path=path: path)} for path in paths]


def test_objects_are_followed_with_masks_and_confidence(serve, clip, images):
    told = serve(
        Request("initialize", images[0], [(Rectangle(*clip.box), {})]),
        Request("frame", images[1], None),
        Request("frame", images[2], [(Mask(clip.masks[2].astype(np.uint8)), {})]),
    )
    assert [len(answer) for answer in told.answers] == [1, 1, 2] and told.reason is None
    for answer, truth in zip(told.answers, clip.masks, strict=True):
        region, properties = answer[0]
        assert mask_iou(region.array() > 0, truth) > 0.6
        assert 0 <= properties["confidence"] <= 1
    assert told.options[2]["multiobject"] is True


def test_a_small_mask_and_a_polygon_lie_where_they_should(serve, clip, images):
    x, y, w, h = (int(side) for side in clip.box)
    small = clip.masks[0][y : y + h, x : x + w].astype(np.uint8)
    corners = Polygon([(x, y), (x + w, y), (x + w, y + h), (x, y + h)])
    ((by_mask, by_polygon),) = serve(
        Request("initialize", images[0], [(Mask(small, (x, y)), {}), (corners, {})])
    ).answers
    for region, _ in (by_mask, by_polygon):
        assert mask_iou(region.array() > 0, clip.masks[0]) > 0.6


def test_a_second_initialize_begins_afresh(serve, clip, images):
    first = Request("initialize", images[0], [(Rectangle(*clip.box), {})])
    assert [len(answer) for answer in serve(first, first).answers] == [1, 1]


def test_the_toolkit_is_told_why_the_server_leaves(serve, clip, images):
    told = serve(Request("initialize", images[0], [(Rectangle(0, 0, 0, 0), {})]))
    assert "has no size" in told.reason and not told.answers
    assert "no-such" in serve(arguments=["--preset", "no-such"]).reason
