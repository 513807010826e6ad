"""Views of a board through a known lens, drawn by its formula."""

from __future__ import annotations

import cv2
import numpy as np

from tracking3d.frames import Frame
from tracking3d.geometry.calibration.calibrate import Board
from tracking3d.geometry.lens import Lens, _picture_to_pinhole

WIDTH, HEIGHT = 480, 360


def lens(model="radtan", coefficients=(-0.25, 0.07, 0.001, -0.0015), focal=420.0) -> Lens:
    taken = (focal, 1.01 * focal, 243.0, 176.0)
    return Lens(model, tuple(coefficients), taken, taken, WIDTH, HEIGHT)


def view(board: Board, lens: Lens, index: int, tilt: float = 35.0, near: bool = True) -> Frame:
    """The board at a place and slant of its own for every index."""
    turn = 2.4 * index
    rotation = cv2.Rodrigues(np.radians(tilt) * np.array([np.cos(turn), np.sin(turn), 0.1]))[0]
    middle = np.array([board.columns, board.rows, 0]) * board.square / 2
    across = 0.17 * np.array([np.cos(1.7 * index), np.sin(1.7 * index)]) * (index % 4 > 0)
    depth = board.rows * board.square * (1.35 if near else 4.0)
    translation = np.array([*(across * depth * (1.6, 1.0)), depth]) - rotation @ middle
    fx, fy, cx, cy = lens.pinhole
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    pixels = 40
    to_board = np.diag([board.square / pixels, board.square / pixels, 1.0])
    onto = K @ np.column_stack([rotation[:, :2], translation]) @ to_board
    drawn = cv2.copyMakeBorder(
        board.picture(pixels), pixels, pixels, pixels, pixels, cv2.BORDER_CONSTANT, value=255
    )
    x, y = _picture_to_pinhole(lens)
    rays = np.linalg.inv(onto) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    u, v = (rays[:2] / rays[2] - 0.5 + pixels).reshape(2, HEIGHT, WIDTH).astype(np.float32)
    soft = cv2.GaussianBlur(drawn, (0, 0), 1.0)
    grey = cv2.remap(soft, u, v, cv2.INTER_LINEAR, borderValue=110)
    return Frame(index, np.repeat(grey[..., None], 3, 2), name=f"frame {index}")
