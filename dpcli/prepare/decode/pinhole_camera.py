"""Pinhole cameras: intrinsics, and depth images turned into points."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.prepare.decode.cv2_import import load_cv2

_AMBIGUOUS = 20.0  # raw units per meter; a file that declares fewer may have meant something else
_ASPECT = 0.01  # how much two shapes of pictures may differ and still be one picture at two sizes
_WIDEST, _LONGEST = 0.1, 1000  # focal lengths in sides of the picture: of 157 degrees, and of what no depth camera has
_KINECT_MODES = {  # width and height of an Azure Kinect's depth: pixels of its sensor a side, first column and row of what is left
    (640, 576): (1, 192, 180),
    (320, 288): (2, 96, 90),
    (512, 512): (2, 0, 0),
    (1024, 1024): (1, 0, 0),
}
_TURNED, _UPRIGHT = 0.2, 0.1  # how far off the middle a principal point lies in turned pictures, and in those before
OF_COLORS = re.compile("colou?r|rgb", re.IGNORECASE)  # in a camera's name
_IF_ALIGNED = ", which is right for depth that was aligned to the colors"
_LIKE = 0.01  # share by which cameras of frames differ that one stands for
_ARRIVES = 1e-3  # focal lengths by which a ray may miss its pixel
_MIDDLE, _ALIKE = (0.35, 0.7), 0.06  # where a principal point lies, as shares of the sides; by how much these differ


@dataclass(frozen=True)
class Intrinsics:
    """Holds focal lengths and principal point, in pixels; pixel (0, 0) is the center of the top-left one."""

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in (self.fx, self.fy, self.cx, self.cy)) or self.fx <= 0 or self.fy <= 0:
            upright = " (pictures that stand upright, as ICL-NUIM's do, have a positive fy)" if self.fy < 0 else ""
            raise UsageError(f"intrinsics must be finite with positive focal lengths, found {self}{upright}")

    @classmethod
    def from_field_of_view(cls, degrees: float, width: int, height: int) -> Intrinsics:
        """Returns a camera of square pixels, center in the middle; ``degrees`` is the HORIZONTAL field of view.

        >>> round(Intrinsics.from_field_of_view(90, 640, 480).fx, 6)
        320.0
        """
        if not 0 < degrees < 180:
            raise UsageError(f"a field of view is between 0 and 180 degrees, found {degrees:g}")
        focal = width / 2 / math.tan(math.radians(degrees) / 2)
        return cls(focal, focal, (width - 1) / 2, (height - 1) / 2)


@dataclass(frozen=True)
class LensIntrinsics(Intrinsics):
    """Holds intrinsics of a lens that bends lines: OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 s1 .. s4 tx ty, or the first of them."""

    distortion: tuple[float, ...] = ()


@lru_cache(maxsize=8)
def pixel_rays(height: int, width: int, intrinsics: Intrinsics) -> np.ndarray:
    """Returns rays through every pixel at unit depth, f32 (H*W, 3) in raster order; z is 1. Camera axes OpenCV."""
    x = (np.arange(width) - intrinsics.cx) / intrinsics.fx
    y = (np.arange(height) - intrinsics.cy) / intrinsics.fy
    rays = np.ones((height, width, 3), np.float32)
    if isinstance(intrinsics, LensIntrinsics):
        rays[..., :2] = _straightened(x, y, intrinsics.distortion)
    else:
        rays[..., 0] = x
        rays[..., 1] = y[:, None]
    rays.setflags(write=False)
    return rays.reshape(-1, 3)


def _straightened(x: np.ndarray, y: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Returns where a lens sends rays from, f64 (H,W,2), that arrive at x (W) and y (H): the distortion undone; NaN where it sends
    none, as to the corners of a wide lens's pictures, for which OpenCV finds anything.
    """
    bent = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    cv2 = load_cv2()
    precise = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    if hasattr(cv2, "undistortPointsIter"):  # what OpenCV 4 calls it
        found = cv2.undistortPointsIter(bent, np.eye(3), np.array(distortion), None, None, precise)
    else:
        found = cv2.undistortPoints(bent, np.eye(3), np.array(distortion), criteria=precise)
    rays = np.concatenate([found, np.ones_like(found[..., :1])], axis=-1)
    again = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))[0]
    found[~(np.abs(again - bent).max(axis=-1) < _ARRIVES)] = np.nan
    return found.reshape(len(y), len(x), 2)


def count_blind(depth: np.ndarray, intrinsics: Intrinsics) -> int:
    """Returns how many pixels have a depth in frames (T,H,W) where the lens sends no ray, which `back_project` leaves out."""
    height, width = depth.shape[1:]
    blind = np.isnan(pixel_rays(height, width, intrinsics)[:, 0]).reshape(height, width)
    return int(np.count_nonzero(depth[:, blind] > 0)) if blind.any() else 0


@lru_cache(maxsize=8)
def _complex_rays(height: int, width: int, intrinsics: Intrinsics) -> np.ndarray:
    """Returns x + iy of `pixel_rays`, complex64 (H*W): one number is taken three times as fast as a row."""
    rays = np.ascontiguousarray(pixel_rays(height, width, intrinsics)[:, :2])
    return rays.view(np.complex64).reshape(-1)


def back_project(
    depth: np.ndarray, intrinsics: Intrinsics, *, unit: float = 1.0, near: float = 0.0, far: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Turns depth frames into points: x = (u - cx) / fx * z, y = (v - cy) / fy * z, for every pixel with z > 0 in
    near..far that a ray reaches.

    depth: (T,H,W), any real dtype, 0 or less = nothing seen; z is depth * unit in float32 -> points f32 (P,3) in raster
    order within each frame, frames one after the other; counts i64 (T) of points per frame.

    >>> depth = np.array([[[0, 0, 0], [0, 0, 2000]]], np.uint16)  # one pixel of a 3 x 2 picture sees something, in mm
    >>> points, counts = back_project(depth, Intrinsics(8, 8, 1, 0.5), unit=0.001)
    >>> points.tolist(), counts.tolist()
    ([[0.25, 0.125, 2.0]], [1])
    """
    frames, height, width = depth.shape
    rays = _complex_rays(height, width, intrinsics)
    # what is not seen is dropped before anything is computed: most pixels of a cut-out person or hand
    reached = ~np.isnan(rays.real)
    reached = None if reached.all() else reached
    seen = [_seen(frame, np.float32(unit), near, far, reached) for frame in depth.reshape(frames, height * width)]
    counts = np.array([len(pixels) for pixels, _ in seen], np.int64)
    points = np.empty((int(counts.sum()), 3), np.float32)
    start = 0
    for pixels, z in seen:
        block = points[start : start + len(pixels)]
        ray = rays.take(pixels, mode="clip")
        np.multiply(ray.real, z, out=block[:, 0])  # column by column: long loops instead of many of three numbers
        np.multiply(ray.imag, z, out=block[:, 1])
        block[:, 2] = z
        start += len(pixels)
    return points, counts


def _seen(
    frame: np.ndarray, unit: np.float32, near: float, far: float, reached: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns pixels i64 (P) of a flat frame in which something was seen in near..far, and its depth f32 (P). reached: which
    pixels a ray reaches, None for all.
    """
    pixels = np.flatnonzero(frame > 0) if reached is None else np.flatnonzero((frame > 0) & reached)
    if near > 0 or far < np.inf:
        z = _lengths(frame, pixels, unit)
        pixels = pixels[(z >= near) & (z <= far)]
    return pixels, _lengths(frame, pixels, unit)


def _lengths(frame: np.ndarray, pixels: np.ndarray, unit: np.float32) -> np.ndarray:
    # float64 would double the traffic for nothing: raw depths are integers below 2**24 or meters
    z = frame.take(pixels).astype(np.float32)
    if unit != 1:
        z *= unit
    return z


def _off_middle(across: float, down: float) -> float:
    return abs(across - 0.5) + abs(down - 0.5)


@dataclass(frozen=True)
class Calibration:
    """Holds a camera's intrinsics, the size of the pictures they are for (0 = not known), and raw depth units per meter.

    chosen: what the camera is called where the file holds others, too, or where it is one of colors.
    """

    intrinsics: Intrinsics
    width: int = 0
    height: int = 0
    depth_scale: float | None = None
    source: str = "the options"
    chosen: str = ""

    @property
    def is_of_colors(self) -> bool:
        """Returns whether its name in the file says that it is a color camera's."""
        return OF_COLORS.search(self.chosen) is not None

    def is_like(self, other: Calibration | None) -> bool:
        """Returns whether another camera is this one, but for what calibrating anew changes."""
        if other is None:
            return False
        pairs = ((getattr(one.intrinsics, name) for name in ("fx", "fy", "cx", "cy")) for one in (self, other))
        return np.allclose(*map(list, pairs), rtol=_LIKE)

    def of_pictures(self, width: int, height: int) -> Intrinsics:
        """Returns the intrinsics for pictures of that size: scaled, when the calibration's have the same shape.

        Raises DataError when they are of another shape, when the principal point lies outside of the pictures or is that of turned ones,
        or when a focal length can't be one in pixels.
        """
        own, found = f"{self.width}x{self.height}", f"{width}x{height}"
        camera = self.intrinsics
        if self.width and self.height and (self.width, self.height) != (width, height):
            x, y = width / self.width, height / self.height
            if abs(x / y - 1) > _ASPECT:
                raise DataError(
                    f"{self.source}: is of {own} pictures, these have {found}, which is another shape; expected the"
                    " calibration of the depth camera itself"
                )
            middle = ((camera.cx + 0.5) * x - 0.5, (camera.cy + 0.5) * y - 0.5)
            camera = replace(camera, fx=camera.fx * x, fy=camera.fy * y, cx=middle[0], cy=middle[1])
        if 0 < camera.cx <= 1 and 0 < camera.cy <= 1 and min(width, height) > 8:
            raise DataError(
                f"{self.source}: the principal point ({camera.cx:g}, {camera.cy:g}) seems to be a fraction of the picture;"
                f" expected pixels of these {found} pictures: multiply fx and cx by the width, fy and cy by the height"
            )
        across, down = (camera.cx + 0.5) / width, (camera.cy + 0.5) / height
        turned = ((camera.cy + 0.5) / width, (camera.cx + 0.5) / height)
        if not self.width and _off_middle(across, down) > _TURNED and _off_middle(*turned) < _UPRIGHT:
            raise DataError(
                f"{self.source}: the principal point ({camera.cx:g}, {camera.cy:g}) seems to be that of pictures that were turned by a"
                f" quarter into these {found} ones; expected fx and fy exchanged, and cx and cy counted from the sides that are left and"
                " top now"
            )
        outside = not (0 <= across <= 1 + 0.5 / width and 0 <= down <= 1 + 0.5 / height)
        scaled = not self.width and abs(across - down) < _ALIKE and not _MIDDLE[0] < across < _MIDDLE[1]
        if outside or scaled:
            where = "lies outside of" if outside else "seems to be of another size than"
            raise DataError(
                f"{self.source}: the principal point ({camera.cx:g}, {camera.cy:g}) {where} these {found} pictures;"
                " expected a calibration of pictures of this size, or its width and height beside it"
            )
        shares = (camera.fx / width, camera.fy / height)
        if min(shares) < _WIDEST or max(shares) > _LONGEST:
            raise DataError(
                f"{self.source}: focal lengths of {camera.fx:g} and {camera.fy:g} pixels for {found} pictures, which no depth camera"
                " has; expected pixels, not millimeters or degrees: pixels = millimeters x width / the sensor's width"
            )
        return camera

    def require_clear_scale(self) -> None:
        """Raises DataError when the declared raw units per meter are so few that they mean something else."""
        if self.depth_scale is not None and self.depth_scale < _AMBIGUOUS:
            raise DataError(
                f"{self.source}: declares a depth scale that would be {self.depth_scale:g} raw units per meter, which is"
                " hardly meant for whole numbers; give --depth-scale, such as 1000 for millimeters"
            )

    def notes(self) -> list[str]:
        """Returns lines for the log about what the calibration declares beside the intrinsics."""
        declared = [f"pictures of {self.width}x{self.height}"] if self.width else []
        declared += [f"{self.depth_scale:g} raw units per meter"] if self.depth_scale else []
        declared += ["a lens to be straightened"] if isinstance(self.intrinsics, LensIntrinsics) else []
        which = f"the camera called {self.chosen} is taken{_IF_ALIGNED * self.is_of_colors}"
        return ([f"{self.source}: {which}"] if self.chosen else []) + (
            [f"{self.source}: declares {', '.join(declared)}"] if declared else []
        )


class KinectCalibration(Calibration):
    """Holds the camera of the whole sensor of an Azure Kinect's depth, of which each mode shows another part."""

    def of_pictures(self, width: int, height: int) -> Intrinsics:
        """Returns the intrinsics of the mode whose pictures have this size. Raises DataError where none has."""
        mode = _KINECT_MODES.get((width, height))
        if mode is None:
            modes = ", ".join(f"{w}x{h}" for w, h in _KINECT_MODES)
            raise DataError(
                f"{self.source}: is of an Azure Kinect, whose depth has {modes} pixels, these pictures have {width}x{height}; if"
                " they were transformed to the color camera or resized, give --fx --fy --cx --cy of the result"
            )
        (pixels, left, top), camera = mode, self.intrinsics
        x, y = ((middle + 0.5) / pixels - 0.5 for middle in (camera.cx, camera.cy))
        return replace(camera, fx=camera.fx / pixels, fy=camera.fy / pixels, cx=x - left, cy=y - top)
