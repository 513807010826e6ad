"""Calibration boards: drawing them for print, and detecting them in images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError

Kind = Literal["charuco", "chessboard"]
KINDS: tuple[Kind, ...] = ("charuco", "chessboard")
DICTIONARY = cv2.aruco.DICT_5X5_250
"""Dictionary of the markers of a ChArUco board."""
MARKER = 0.75
"""Side of a marker in squares."""
LARGEST = 25
"""Largest number of squares along a side."""


@dataclass(frozen=True)
class Board:
    """A flat board of black and white squares.

    Attributes:
        columns, rows: Numbers of squares.
        kind: ``charuco`` has a marker in every white square, so that a part of it is enough.
        square: Side of a square in millimetres; it changes nothing of the camera.
    """

    columns: int = 7
    rows: int = 10
    kind: Kind = "charuco"
    square: float = 25.0

    def __post_init__(self) -> None:
        if not (3 <= self.columns <= LARGEST and 3 <= self.rows <= LARGEST):
            raise InputError(
                f"A board of {self.columns} x {self.rows} squares cannot be used; give 3 to {LARGEST} "
                "squares along each side."
            )
        if self.kind == "charuco" and self.columns * self.rows // 2 > 250:
            raise InputError(
                f"A ChArUco board of {self.columns} x {self.rows} squares needs more than the available 250 "
                "markers; give fewer squares."
            )
        if not 0 < self.square < 10_000:
            raise InputError(f"Squares of {self.square:g} mm cannot be printed; give millimetres above 0.")

    @property
    def corners(self) -> NDArray[np.float32]:
        """``(N, 3)`` inner corners in millimetres, in the order of their numbers; z is 0."""
        rows, columns = np.mgrid[1 : self.rows, 1 : self.columns]
        flat = np.stack([columns.ravel(), rows.ravel(), np.zeros(columns.size)], 1)
        return (self.square * flat).astype(np.float32)

    def picture(self, pixels: int) -> NDArray[np.uint8]:
        """``(H, W)`` the board with so many pixels a square, and no margin."""
        size = self.columns * pixels, self.rows * pixels
        if self.kind == "charuco":
            drawn: NDArray[np.uint8] = self._charuco.generateImage(size, marginSize=0, borderBits=1)
            return drawn
        rows, columns = np.mgrid[: size[1], : size[0]] // pixels
        return np.where((rows + columns) % 2 == 0, 0, 255).astype(np.uint8)

    def find(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Numbers ``(N,)`` of the corners that are seen in a picture ``(H, W)``, and their pixels ``(N, 2)``."""
        nothing = np.zeros(0, np.int64), np.zeros((0, 2), np.float32)
        if self.kind == "charuco":
            pixels, numbers, _, _ = cv2.aruco.CharucoDetector(self._charuco).detectBoard(grey)
            if numbers is None or not len(numbers):
                return nothing
            return numbers.reshape(-1).astype(np.int64), pixels.reshape(-1, 2)
        found, pixels = cv2.findChessboardCornersSB(
            grey, (self.columns - 1, self.rows - 1), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        if not found:
            return nothing
        return np.arange((self.columns - 1) * (self.rows - 1)), pixels.reshape(-1, 2)

    @property
    def _charuco(self) -> cv2.aruco.CharucoBoard:
        dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square, MARKER * self.square, dictionary
        )


def parse_squares(text: str) -> tuple[int, int]:
    """``COLUMNSxROWS``, such as ``7x10``.

    Raises:
        InputError: If it is anything else.
    """
    columns, _, rows = text.casefold().partition("x")
    if not (columns.isascii() and columns.isdigit() and rows.isascii() and rows.isdigit()) or len(text) > 9:
        raise InputError(f"--squares '{text}' is not COLUMNSxROWS, such as 7x10.")
    return int(columns), int(rows)
