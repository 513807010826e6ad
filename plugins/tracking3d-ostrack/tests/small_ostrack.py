"""Networks of OSTrack's and AlphaRefine's signatures that look for the colour in the middle of the template."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

HEAD = '<ir_version: 8, opset_import: ["": 17]>'

COLOUR = """
    middle = Slice (REFERENCE, from, to, axes)
    colour = ReduceMean <axes = [2, 3]> (middle)
    difference = Sub (IMAGE, colour)
    squares = Mul (difference, difference)
    distance = ReduceMean <axes = [1]> (squares)
    nearness = Sub (near, distance)
    scaled = Mul (nearness, steepness)
    likeness = Sigmoid (scaled)
"""

OSTRACK = """
small_ostrack (float[1,3,128,128] template, float[1,3,256,256] search) => (OUTPUTS)
  <int64[2] from = {52, 52}, int64[2] to = {76, 76}, int64[2] axes = {2, 3}, float near = {1.0},
   float steepness = {20.0}, float[1,1,1,16] columns = {COLUMNS}, float[1,1,16,1] rows = {COLUMNS},
   float[1,1,1,16] column = {NUMBERS}, float[1,1,16,1] row = {NUMBERS}, float sixteen = {16.0},
   float disc = {1.2732395}, float little = {0.000001}, int64[4] maps = {1, 1, 16, 16}, int64[3] flat = {1, 1, 4}>
{
    COLOUR
    score_map = AveragePool <kernel_shape = [16, 16], strides = [16, 16]> (likeness)
    mean = ReduceMean <axes = [2, 3]> (score_map)
    total = Add (mean, little)
    of_columns = Mul (score_map, columns)
    of_rows = Mul (score_map, rows)
    x_sum = ReduceMean <axes = [2, 3]> (of_columns)
    y_sum = ReduceMean <axes = [2, 3]> (of_rows)
    x = Div (x_sum, total)
    y = Div (y_sum, total)
    box_area = Mul (total, disc)
    side = Sqrt (box_area)
    side_map = Expand (side, maps)
    size_map = Concat <axis = 1> (side_map, side_map)
    x_cells = Mul (x, sixteen)
    y_cells = Mul (y, sixteen)
    right = Sub (x_cells, column)
    down = Sub (y_cells, row)
    right_map = Expand (right, maps)
    down_map = Expand (down, maps)
    offset_map = Concat <axis = 1> (right_map, down_map)
    parts = Concat <axis = 1> (x, y, side, side)
    pred_boxes = Reshape (parts, flat)
}
"""

MAPS = "float[1,1,16,16] score_map, float[1,2,16,16] size_map, float[1,2,16,16] offset_map"
BOXES = "float[1,1,4] pred_boxes"

REFINE = """
small_refine (float[1,3,256,256] train_imgs, float[1,4] train_bb, float[1,3,256,256] test_imgs)
  => (float[1,1,256,256] mask)
  <int64[2] from = {96, 96}, int64[2] to = {160, 160}, int64[2] axes = {2, 3}, float near = {1.0},
   float steepness = {20.0}>
{
    COLOUR
    mask = Identity (likeness)
}
"""


def write_ostrack(file: Path, outputs: str = MAPS) -> Path:
    """Write a small OSTrack that gives the maps of the centre head, or the final box."""
    numbers = range(16)
    text = OSTRACK.replace("OUTPUTS", outputs).replace("COLOUR", COLOUR)
    text = text.replace("REFERENCE", "template").replace("IMAGE", "search")
    text = text.replace("COLUMNS", ", ".join(f"{(n + 0.5) / 16}" for n in numbers))
    return save(file, text.replace("NUMBERS", ", ".join(f"{n}.0" for n in numbers)))


def write_refine(file: Path) -> Path:
    """Write a small AlphaRefine."""
    text = REFINE.replace("COLOUR", COLOUR)
    return save(file, text.replace("REFERENCE", "train_imgs").replace("IMAGE", "test_imgs"))


def write_constant_ostrack(file: Path, score: np.ndarray, size: np.ndarray, offset: np.ndarray) -> Path:
    """Write a network that answers with given maps whatever it sees."""
    text = HEAD + f"g (float[1,3,128,128] template, float[1,3,256,256] search) => ({MAPS}) {{\n"
    for name in ("score", "size", "offset"):
        text += f"{name}_map = Identity ({name})\n"
    model = onnx.parser.parse_model(text + "}")
    for name, values in (("score", score), ("size", size), ("offset", offset)):
        model.graph.initializer.append(onnx.numpy_helper.from_array(values.astype(np.float32), name))
    onnx.save(model, str(file))
    return file


def save(file: Path, graph: str) -> Path:
    """Parse and write a graph."""
    model = onnx.parser.parse_model(HEAD + graph)
    onnx.checker.check_model(model)
    onnx.save(model, str(file))
    return file
