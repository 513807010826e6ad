"""Calibration of a camera and its lens distortion from views of a board."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.geometry.calibration.camera_files import CalibratedCamera
from tracking3d.geometry.lens import COUNTS, Model

LEAST_CORNERS = 8
"""Corners of one view."""
LEAST_VIEWS = 6
MOST_VIEWS = 40
"""Maximum number of views; of more, those that differ most are used."""
CELLS = (6, 8)
"""Rows and columns of the grid that coverage is counted in."""
LEAST_COVERAGE = 0.4
LEAST_TILT = 12.0
"""Degrees between the two views of the board that differ most; without tilts the focal length is not observable."""
LARGEST_ERROR = 2.0
"""Pixels of reprojection error (root mean square) above which the corners are not those of the board."""
_OUTLIER, _ROUNDS = 3.0, 3


@dataclass(frozen=True, eq=False)
class BoardView:
    """The board in one frame."""

    index: int  # the frame
    numbers: NDArray[np.int64]  # (N,) which corners are seen
    pixels: NDArray[np.float32]  # (N, 2) where


@dataclass(frozen=True, eq=False)
class Calibration:
    """What came of it."""

    camera: CalibratedCamera  # the camera
    error: float  # reprojection error in pixels, root mean square over all corners
    errors: dict[int, float]  # the same of each view, by its frame
    coverage: float  # share of the picture's cells that a corner was seen in, see `CELLS`
    focal_deviation: float | None  # standard deviation of the focal length in pixels; None of a fisheye
    left_out: dict[int, str] = field(default_factory=dict)  # why a frame has no part in it, by its index


def find_views(
    frames: Iterable[Frame | SkippedFrame], board: Board
) -> tuple[list[BoardView], tuple[int, int], dict[int, str]]:
    """Look for the board in every frame.

    Returns:
        The views, ``(width, height)`` of the frames, and why the others are none.
    """
    views: list[BoardView] = []
    left_out: dict[int, str] = {}
    size = 0, 0
    for frame in frames:
        if isinstance(frame, SkippedFrame):
            left_out[frame.index] = frame.reason
            continue
        size = frame.size[1], frame.size[0]
        numbers, pixels = board.find(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY))
        if len(numbers) < LEAST_CORNERS:
            left_out[frame.index] = f"{len(numbers)} corners found" if len(numbers) else "no board found"
        elif _in_a_line(board.corners[numbers]):
            left_out[frame.index] = "its corners lie in one line"
        else:
            views.append(BoardView(frame.index, numbers, pixels))
    return views, size, left_out


def calibrate(
    frames: Iterable[Frame | SkippedFrame], board: Board, model: Model = "radtan", name: str = "the source"
) -> Calibration:
    """Calibrate a camera.

    Args:
        frames: Images of the board from many sides.
        board: The board.
        model: ``radtan`` with five coefficients, or ``fisheye``.
        name: Name of the source in messages.

    Raises:
        InputError: If there are too few views, they leave too much of the picture out, they are all from one side, or
            no camera explains them.
    """
    views, size, left_out = find_views(frames, board)
    if len(views) < LEAST_VIEWS:
        raise InputError(
            f"{name} shows the {board.kind} board of {board.columns} x {board.rows} squares in {len(views)} "
            f"of {len(views) + len(left_out)} frames, but at least {LEAST_VIEWS} are needed; film the whole "
            "board sharply from many sides, and check --squares and --board."
        )
    kept = spread_views(views, size, MOST_VIEWS)
    left_out |= {view.index: "like another view" for view in views if view not in kept}
    _check_coverage(kept, size, name)
    for _ in range(_ROUNDS):
        solved = _solve(kept, board, size, model, name)
        limit = max(_OUTLIER * float(np.median(list(solved.errors.values()))), 0.3)
        bad = [view for view in kept if solved.errors[view.index] > limit]
        if not bad or len(kept) - len(bad) < LEAST_VIEWS:
            break
        left_out |= {view.index: f"{solved.errors[view.index]:.2g} pixels off, an outlier" for view in bad}
        kept = [view for view in kept if view not in bad]
    else:
        solved = _solve(kept, board, size, model, name)
    _check_coverage(kept, size, name)
    if solved.error > LARGEST_ERROR:
        raise InputError(
            f"No camera model fits the views of the board in {name}: the reprojection error is "
            f"{solved.error:.1f} pixels; check that the board is flat, sharp and the one of --squares, and "
            "that the zoom is fixed. A very wide lens needs --model fisheye."
        )
    return Calibration(
        solved.camera,
        solved.error,
        solved.errors,
        coverage(kept, size),
        solved.focal_deviation,
        dict(sorted(left_out.items())),
    )


def coverage(views: Sequence[BoardView], size: tuple[int, int]) -> float:
    """Share of the cells of the picture that a corner was seen in."""
    return float(_cells(views, size).mean())


def spread_views(views: Sequence[BoardView], size: tuple[int, int], most: int) -> list[BoardView]:
    """At most so many views, those that differ most in place, size and slant, in their order."""
    if len(views) <= most:
        return list(views)
    looks = np.array([_look(view, size) for view in views])
    chosen = [int(np.argmax([len(view.numbers) for view in views]))]
    apart = np.linalg.norm(looks - looks[chosen[0]], axis=1)
    while len(chosen) < most:
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(looks - looks[chosen[-1]], axis=1))
    return [views[number] for number in sorted(chosen)]


def _look(view: BoardView, size: tuple[int, int]) -> NDArray[np.float64]:
    """Middle and spread of the corners, in widths of the picture."""
    pixels = view.pixels / size[0]
    spread = np.cov(pixels.T)
    return np.array(
        [*pixels.mean(0), *2 * np.sqrt(np.diag(spread)), 4 * spread[0, 1] / np.sqrt(np.prod(np.diag(spread)))]
    )


def _cells(views: Sequence[BoardView], size: tuple[int, int]) -> NDArray[np.bool_]:
    cells = np.zeros(CELLS, bool)
    for view in views:
        column, row = (view.pixels / size * CELLS[::-1]).astype(int).T
        cells[row.clip(0, CELLS[0] - 1), column.clip(0, CELLS[1] - 1)] = True
    return cells


def _check_coverage(views: Sequence[BoardView], size: tuple[int, int], name: str) -> None:
    cells = _cells(views, size)
    if cells.mean() >= LEAST_COVERAGE:
        return
    thirds = {
        "left": cells[:, : CELLS[1] // 3],
        "right": cells[:, -(CELLS[1] // 3) :],
        "upper": cells[: CELLS[0] // 3],
        "lower": cells[-(CELLS[0] // 3) :],
    }
    worst = min(thirds, key=lambda side: float(thirds[side].mean()))
    raise InputError(
        f"The board covers only {100 * cells.mean():.0f} % of the image of {name}, least in its {worst} "
        f"part; move it through the whole image, corners included (at least {100 * LEAST_COVERAGE:.0f} %)."
    )


def _in_a_line(corners: NDArray[np.float32]) -> bool:
    return bool(np.linalg.svd(corners[:, :2] - corners[:, :2].mean(0), compute_uv=False)[1] < 1e-3)


def _solve(
    views: Sequence[BoardView], board: Board, size: tuple[int, int], model: Model, name: str
) -> Calibration:
    corners = [board.corners[view.numbers] for view in views]
    pixels = [view.pixels for view in views]
    try:
        solve = _solve_fisheye if model == "fisheye" else _solve_radtan
        K, k, rotations, translations, deviation = solve(corners, pixels, size)
    except cv2.error as error:
        raise InputError(
            f"No camera can be computed from the views of {name} ({error.err}); film the board from more sides."
        ) from error
    if not np.isfinite(K).all() or not np.isfinite(k).all():
        raise InputError(
            f"No camera can be computed from the views of {name}; film the board from more sides."
        )
    _check_tilt(rotations, name)
    errors = {}
    total = count = 0.0
    for view, points, seen, R, t in zip(views, corners, pixels, rotations, translations, strict=True):
        if model == "fisheye":
            again = cv2.fisheye.projectPoints(points[None].astype(np.float64), R, t, K, k)[0]
        else:
            again = cv2.projectPoints(points, R, t, K, k)[0]
        square = ((again.reshape(-1, 2) - seen) ** 2).sum(1)
        errors[view.index] = float(np.sqrt(square.mean()))
        total, count = total + float(square.sum()), count + len(square)
    intrinsics = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    coefficients = tuple(
        float(one) for one in k.reshape(-1)[: COUNTS[model][-1 if model == "fisheye" else 1]]
    )
    camera = CalibratedCamera(intrinsics, model, coefficients, size, f"calibration by {name}")
    return Calibration(camera, float(np.sqrt(total / count)), errors, 0.0, deviation)


def _solve_radtan(corners, pixels, size):  # type: ignore[no-untyped-def]
    _, K, k, rotations, translations, deviations, _, _ = cv2.calibrateCameraExtended(
        corners, [one.reshape(-1, 1, 2) for one in pixels], size, None, None
    )
    return K, k, rotations, translations, float(deviations[0, 0])


def _solve_fisheye(corners, pixels, size):  # type: ignore[no-untyped-def]
    flags = 0
    for name in ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW", "CALIB_USE_INTRINSIC_GUESS"):
        flags |= getattr(cv2.fisheye, name, None) or getattr(cv2, name)  # OpenCV 5 has moved them
    guess = np.array([[size[0] / 2.5, 0, size[0] / 2], [0, size[0] / 2.5, size[1] / 2], [0, 0, 1.0]])
    _, K, k, rotations, translations = cv2.fisheye.calibrate(
        [one[None].astype(np.float64) for one in corners],
        [one[None].astype(np.float64) for one in pixels],
        size,
        guess,
        np.zeros(4),
        flags=flags,
    )
    return K, k, rotations, translations, None


def _check_tilt(rotations: Sequence[NDArray[np.float64]], name: str) -> None:
    normals = np.array([cv2.Rodrigues(one)[0][:, 2] for one in rotations])
    tilt = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))
    if tilt < LEAST_TILT:
        raise InputError(
            f"All views of the board in {name} are from one side (within {tilt:.0f} degrees), so the focal "
            f"length cannot be estimated; tilt the board by {LEAST_TILT:.0f} degrees or more in several "
            "directions."
        )


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
