"""A network of D3S' signature that compares colours with those of the template's object and background."""

from __future__ import annotations

from pathlib import Path

import pytest

onnx = pytest.importorskip("onnx")

GRAPH = """
<ir_version: 8, opset_import: ["": 17]>
small_d3s (float[1,3,SIZE,SIZE] train_imgs, float[1,3,SIZE,SIZE] test_imgs,
           float[1,1,SIZE,SIZE] train_masks, float[1,1,SIZE,SIZE] test_dist)
  => (float[1,2,SIZE,SIZE] segmentation)
  <float one = {1.0}, float least = {0.000001}, float steepness = {20.0}, float far = {0.004}>
{
    rest = Sub (one, train_masks)
    mean_object = ReduceMean <axes = [2, 3]> (train_masks)
    mean_rest = ReduceMean <axes = [2, 3]> (rest)
    object_share = Max (mean_object, least)
    rest_share = Max (mean_rest, least)
    of_object = Mul (train_imgs, train_masks)
    of_rest = Mul (train_imgs, rest)
    object_sum = ReduceMean <axes = [2, 3]> (of_object)
    rest_sum = ReduceMean <axes = [2, 3]> (of_rest)
    object_colour = Div (object_sum, object_share)
    rest_colour = Div (rest_sum, rest_share)
    to_object = Sub (test_imgs, object_colour)
    to_rest = Sub (test_imgs, rest_colour)
    to_object_2 = Mul (to_object, to_object)
    to_rest_2 = Mul (to_rest, to_rest)
    object_distance = ReduceMean <axes = [1]> (to_object_2)
    rest_distance = ReduceMean <axes = [1]> (to_rest_2)
    away = Mul (test_dist, far)
    object_cost = Add (object_distance, away)
    both = Concat <axis = 1> (object_cost, rest_distance)
    scaled = Mul (both, steepness)
    segmentation = Neg (scaled)
}
"""


def write_small_d3s(file: Path, size: int = 384) -> Path:
    """Write the network for crops of ``size``."""
    model = onnx.parser.parse_model(GRAPH.replace("SIZE", str(size)))
    onnx.checker.check_model(model)
    onnx.save(model, str(file))
    return file
