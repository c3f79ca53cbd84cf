"""The files that KITTI's benchmarks share: calibration, Velodyne scans, 16-bit PNGs; and what the left camera sees."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.prepare.decode.png import decode_picture
from dpcli.prepare.reader import require_folder
from dpcli.prepare.series import is_hidden

OUTSIDE = "points outside the camera's view, --near and --far dropped"
_SHORTEST_FOCAL = 10.0  # pixels; less is no camera but a matrix that somebody had to fill in
COORDINATES = ("published", "camera")
IMAGE_SIZE = (1242, 375)  # pixels, width and height of most of KITTI's pictures


def check_objects(chosen: Collection[str], known: Collection[str]) -> None:
    """Raises UsageError unless some classes of objects are chosen, all of them known."""
    if not chosen or set(chosen) - set(known):
        raise UsageError(f"--objects {','.join(chosen)}: expected some of {', '.join(known)}")


def orient_points(points: np.ndarray, coordinates: str) -> np.ndarray:
    """Returns camera points (N,3) (x right, y down, z forward) as f32; ``published``: x left, y up, z forward, a half
    turn.
    """
    return (points * ([-1, -1, 1] if coordinates == "published" else [1, 1, 1])).astype(np.float32)


def training_folder(raw: Path, holds: str) -> Path:
    """Returns ``raw``/training, or ``raw`` where it is that folder.

    Raises DataError when neither has the folder ``holds``.
    """
    require_folder(raw, f"training/{holds}/ in it, as KITTI distributes it")
    for folder in (raw / "training", raw):
        if (folder / holds).is_dir():
            return folder
    raise DataError(f"{raw}: no training/{holds}/ in it; expected the folders of KITTI's archives, unpacked together")


def names_in(folder: Path, ending: str) -> list[str]:
    """Returns the names of the files directly in a folder that end so, sorted, without the ending; hidden ones, such as what macOS
    packs beside every file, are passed over.
    """
    return sorted(path.name.removesuffix(ending) for path in folder.glob(f"*{ending}") if not is_hidden(path.name))


def missing_files_problem(paths: list[Path]) -> str:
    """Returns the problem of an item whose files are not all there; "" when they are."""
    missing = [path for path in paths if not path.is_file()]
    more = f" and {len(missing) - 1} more files of this scene" if len(missing) > 1 else ""
    return f"{missing[0]}: missing{more}" if missing else ""


def read_calibration(path: Path) -> dict[str, np.ndarray]:
    """Reads ``KEY: numbers`` lines as f64 arrays; lines that hold no numbers, such as calib_time, are passed over."""
    try:
        text = path.read_text("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{path}: not text; expected lines such as 'P2: 7.215377e+02 0.0 ...'") from None
    found = {}
    for line in text.splitlines():
        key, colon, rest = line.partition(":")
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
        if colon and len(values):
            found[key.strip()] = values
    return found


def calibration_matrix(found: dict[str, np.ndarray], path: Path, key: str) -> np.ndarray:
    """Returns a 3x4 (12 numbers) or 3x3 (9 numbers) matrix of a calibration file, as f64 (4,4) filled up with the
    identity.
    """
    if key not in found:
        raise DataError(f"{path}: no line '{key}:'; found {', '.join(sorted(found)) or 'no calibration at all'}")
    values = found[key]
    if len(values) not in (9, 12) or not np.isfinite(values).all():
        raise DataError(f"{path}: {key} has {len(values)} numbers; expected 12 (3x4) or 9 (3x3), all finite")
    matrix = np.eye(4)
    matrix[:3, : len(values) // 3] = values.reshape(3, -1)
    return matrix


def read_velodyne(path: Path) -> np.ndarray:
    """Reads a scan f32 (N,3): x forward, y left, z up, meters. The file: float32 x y z reflectance, little-endian."""
    data = path.read_bytes()
    if not data or len(data) % 16:
        raise DataError(
            f"{path}: {len(data)} bytes; expected some points of 16 (float32 x y z reflectance); copy it again"
        )
    points = np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3]
    if not np.isfinite(points).all():
        raise DataError(
            f"{path}: {counted(int((~np.isfinite(points)).any(1).sum()), 'point')} NaN or infinite; copy it again"
        )
    return points


def read_png(
    path: Path, channels: int, size: tuple[int, int] | None = None, bits: tuple[int, ...] = (16,)
) -> np.ndarray:
    """Reads an image (H,W) or (H,W,channels) in the file's channel order.

    Raises DataError unless type and ``size`` (H,W) agree.
    """
    image = decode_picture(path.read_bytes(), path)
    if image is None:
        raise DataError(f"{path}: not a readable PNG (empty or truncated); copy it again")
    if image.dtype.itemsize * 8 not in bits or (image.shape[2] if image.ndim == 3 else 1) != channels:
        expected = f"{' or '.join(map(str, bits))} bits, {counted(channels, 'channel')}"
        raise DataError(f"{path}: is {image.dtype} {image.shape}; expected {expected}")
    if size is not None and image.shape[:2] != size:
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise DataError(f"{path}: {found} pixels; the scene's other images have {size[1]}x{size[0]}")
    return image[..., ::-1] if image.ndim == 3 else image  # OpenCV turns the channels round


@dataclass(frozen=True)
class View:
    """Says what of a scan is kept: in the left color camera's picture, farther than ``near`` ahead of the scanner,
    nearer than ``far`` from the camera (meters; x of the scanner, z of the camera).
    """

    near: float = 2.0
    far: float = 35.0

    def __post_init__(self) -> None:
        if not 0 < self.near < self.far:
            raise UsageError(f"--near {self.near} --far {self.far}: expected 0 < near < far, meters")

    def crop(
        self,
        scan: np.ndarray,  # f32 (N,3)
        to_camera: np.ndarray,  # f64 (4,4), scanner to rectified camera
        projection: np.ndarray,  # f64 (4,4), camera to pixels
        size: tuple[int, int],  # width, height
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns points in camera axes f64 (M,3) and the indices i64 (M) of those kept: 0 <= u < width, 0 <= v <
        height.
        """
        ahead = np.flatnonzero(scan[:, 0] > self.near)
        points = scan[ahead].astype(np.float64) @ to_camera[:3, :3].T + to_camera[:3, 3]
        u, v, w = (points @ projection[:3, :3].T + projection[:3, 3]).T
        inside = (w > 0) & (points[:, 2] < self.far)
        inside &= (u >= 0) & (u < size[0] * w) & (v >= 0) & (v < size[1] * w)
        return points[inside], ahead[inside]


def is_no_camera(projection: np.ndarray) -> bool:
    """Returns whether a projection f64 (4,4) is the identity or the like, as in scans of one's own without a camera."""
    return abs(float(projection[0, 0])) < _SHORTEST_FOCAL


def to_camera_axes(scan: np.ndarray) -> np.ndarray:
    """Returns a scan (N,3) (x forward, y left, z up), where no camera was calibrated, in a camera's axes: f64 (N,3)."""
    return np.stack([-scan[:, 1], -scan[:, 2], scan[:, 0]], axis=1).astype(np.float64)


def renumber_objects(ids: np.ndarray) -> np.ndarray:
    """Renumbers object ids (N), 0 = background, as i16 (N): 0 stays, the others become 1, 2, ... in rising order.

    >>> renumber_objects(np.array([0, 7, 3, 7])).tolist()
    [0, 2, 1, 2]
    """
    known = np.unique(ids[ids > 0])
    return np.where(ids > 0, np.searchsorted(known, ids) + 1, 0).astype(np.int16)
