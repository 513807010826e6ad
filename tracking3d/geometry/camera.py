"""The one camera of a video, and windows of it.

OpenCV axes: x right, y down, z forward. Pixel (0, 0) is the centre of the top-left pixel. A crop is a *window*
of the one camera (shifted principal point, scaled focal length), never a camera of its own, so that poses stay
comparable from frame to frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.lens import Lens

NEAR = 1e-3
"""Depth in object units from which on a point has an image; faces with a nearer vertex are not drawn."""

DEFAULT_FIELD_OF_VIEW = 45.0
"""Vertical field of view in degrees when nothing better is known (paper section 3.2)."""

OUTERMOST_LENSES = (9.0, 80.0)
"""Vertical fields of view, in degrees, between which a lens is found from a video. Below the narrowest that is tried
first, frames told 6.7 degrees of a plainly wide camera. Phones held upright have 60 to 70, and a limit of 65 kept clips
of 65 degrees at 54.8 and 56.8 (measured)."""
LENS_KNOWN = 0.1
"""Relative standard deviation of the focal length up to which a video tells it; measured. Of four frames it was .17 to
.27 on cube_in_hand and temple_ring, where the focal length was off by a factor of two, .10 on box_in_hand, which was
right by .06; of all frames it is .01 to .03. Nothing at all is known at .3."""
LENS_EXCLUDED = 4.0
"""Standard deviations between two focal lengths from which on a video excludes one of them, however uncertain the
other is; chosen. Four frames of cube_in_hand were 2.8 from the true one, of temple_ring 1.1."""
DEFAULT_ORIGIN = f"default field of view of {DEFAULT_FIELD_OF_VIEW:g} degrees"
_SOLVED = "solved field of view"


@dataclass(frozen=True)
class Camera:
    """A pinhole camera of the full frame.

    Attributes:
        fx, fy: Focal lengths in pixels.
        cx, cy: Principal point in pixels.
        width, height: Frame size in pixels.
        origin: Where the intrinsics came from, in words; recorded in the run.
        assumed: Whether the focal length was not given.
        lens: How the pictures that were taken differ from what this camera sees; None if they do not.
        focal_deviation: Relative standard deviation of the focal length, if it was estimated with one.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    origin: str = "given"
    assumed: bool = False
    lens: Lens | None = None
    focal_deviation: float | None = None

    @classmethod
    def from_fov(
        cls,
        width: int,
        height: int,
        fov: float = DEFAULT_FIELD_OF_VIEW,
        origin: str = "default field of view",
    ) -> Camera:
        """A centred camera with square pixels and a vertical field of view of ``fov`` degrees."""
        focal = 0.5 * height / math.tan(math.radians(fov) / 2)
        return cls(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height, origin)

    @property
    def fov(self) -> float:
        """Vertical field of view in degrees."""
        return 2 * math.degrees(math.atan2(self.height / 2, self.fy))

    @property
    def known(self) -> bool:
        """Whether the lens was given, or else solved from what the video shows."""
        return not self.assumed or self.origin.startswith(_SOLVED)

    def may_have(self, factor: float) -> bool:
        """Whether ``factor`` times the focal lengths is a lens that a video can tell, see `OUTERMOST_LENSES`."""
        return OUTERMOST_LENSES[0] <= self.zoom(factor, "").fov <= OUTERMOST_LENSES[1]

    @property
    def default_factor(self) -> float:
        """What its focal lengths are multiplied by to have the default field of view."""
        return Camera.from_fov(self.width, self.height).fy / self.fy

    def with_solved_focal(self, factor: float) -> Camera:
        """With ``factor`` times the focal lengths, as the video says."""
        other = self.zoom(factor, "")
        return replace(other, origin=f"{_SOLVED} of {other.fov:.1f} degrees")

    def zoom(self, factor: float, origin: str) -> Camera:
        """With ``factor`` times the focal lengths; ``origin`` says in words where that came from."""
        return replace(self, fx=factor * self.fx, fy=factor * self.fy, origin=origin, focal_deviation=None)

    def to_picture(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """This camera's pixels ``(N, 2)`` as those of the pictures that were taken; NaN where the lens sees none."""
        return xy if self.lens is None else self.lens.to_picture(xy)

    def to_pinhole(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels ``(N, 2)`` of the pictures that were taken as those of this camera; NaN where there are none."""
        return xy if self.lens is None else self.lens.to_pinhole(xy)

    def undistort(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture ``(H, W, 3)`` that was taken, as this camera sees it."""
        return image if self.lens is None else self.lens.undistort(image)

    def mask_to_pinhole(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """A mask ``(H, W)`` of a picture that was taken, as one of what this camera sees."""
        return mask if self.lens is None else self.lens.mask_to_pinhole(mask)

    def probability_to_pinhole(self, probability: NDArray[np.float32]) -> NDArray[np.float32]:
        """Probabilities ``(H, W)`` in a picture that was taken, as those in what this camera sees."""
        return probability if self.lens is None else self.lens.mask_to_pinhole(probability)

    @property
    def K(self) -> NDArray[np.float64]:
        """``(3, 3)`` intrinsic matrix of the full frame."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Window:
    """A region of the frame seen at other pixels, square or not; it may reach beyond the frame."""

    left: int  # outer edge of the region: the column of its first pixel in the frame
    top: int  # the row of that pixel
    side: int  # width of the region in frame pixels, and its height if it is square
    size: int  # the same in window pixels
    rows: tuple[int, int] | None = None  # height in frame pixels and in window pixels, if it is not square

    @classmethod
    def around(
        cls, box: tuple[float, float, float, float], margin: float, size: int, enlarge: bool = True
    ) -> Window:
        """The square window centred on ``box`` ``(x, y, w, h)``, ``1 + 2 margin`` times its longer side.

        Without ``enlarge``, a smaller region than ``size`` is seen as it is.
        """
        x, y, width, height = box
        side = max(round(max(width, height) * (1.0 + 2.0 * margin)), 4)
        left, top = round(x + width / 2 - side / 2), round(y + height / 2 - side / 2)
        return cls(left, top, side, size if enlarge else min(side, size))

    @property
    def scale(self) -> float:
        """Window pixels per frame pixel, along a row."""
        return self.size / self.side

    @property
    def sides(self) -> tuple[int, int]:
        """Height and width of the region in frame pixels."""
        return self.side if self.rows is None else self.rows[0], self.side

    @property
    def shape(self) -> tuple[int, int]:
        """``(h, w)``, height and width in window pixels."""
        return self.size if self.rows is None else self.rows[1], self.size

    @property
    def scales(self) -> NDArray[np.float64]:
        """``(2,)`` window pixels per frame pixel, along a row and along a column."""
        return np.array([self.scale, self.shape[0] / self.sides[0]])

    def K(self, camera: Camera) -> NDArray[np.float64]:
        """``(3, 3)`` intrinsics of ``camera`` in this window's pixels."""
        return self.through(camera.K)

    def through(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """Intrinsics ``(3, 3)`` of the frame in this window's pixels.

        Pixel centres are at integers in both grids, so ``u_window = (u + 0.5 - left) * scale - 0.5``.
        """
        sx, sy = self.scales
        centre = (K[0, 2] + 0.5 - self.left) * sx - 0.5, (K[1, 2] + 0.5 - self.top) * sy - 0.5
        return np.array([[sx * K[0, 0], 0.0, centre[0]], [0.0, sy * K[1, 1], centre[1]], [0.0, 0.0, 1.0]])

    @property
    def to_frame(self) -> NDArray[np.float64]:
        """``(3, 3)`` from this window's pixels, homogeneous, to the frame's."""
        across, down = 1 / self.scales
        first = self.left + (0.5 * across - 0.5), self.top + (0.5 * down - 0.5)
        return np.array([[across, 0.0, first[0]], [0.0, down, first[1]], [0.0, 0.0, 1.0]])


def pixel_distance(pixels: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Euclidean distance of every pixel to the nearest one of a set, in pixels, correctly rounded.

    The last bits of OpenCV's exact transform depend on where the image lies in memory, so two equal runs would differ.
    The squared distances are whole numbers, which are rounded before the root is taken again; that is exact up to
    distances of about 1,000 pixels.

    Args:
        pixels: ``(H, W)``, the set.

    Returns:
        ``(H, W)``, 0 at the pixels of the set. If the set is empty, ``H + W`` everywhere, more than any distance.
    """
    if not pixels.any():
        return np.full(pixels.shape, sum(pixels.shape), np.float32)
    distance = cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.sqrt(np.rint(np.square(distance)))
