"""Decodes single messages: points (PointCloud2, Livox's CustomMsg), depth (Image, CompressedImage) and a camera (CameraInfo), of
ROS or of Foxglove.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.prepare.cloud_formats.cloud import BEYOND, Cloud, cloud_of_columns
from dpcli.prepare.decode.lenses import lens_coefficients
from dpcli.prepare.decode.pinhole_camera import Calibration, Intrinsics, LensIntrinsics
from dpcli.prepare.decode.png import decode_picture
from dpcli.prepare.recordings import foxglove
from dpcli.prepare.recordings.livox import LIVOX_KINDS, LivoxScan
from dpcli.prepare.recordings.rvl import unpack_rvl

CLOUD_KINDS = ("sensor_msgs/msg/PointCloud2", *LIVOX_KINDS, *foxglove.CLOUDS)
COMPRESSED_KINDS = ("sensor_msgs/msg/CompressedImage", *foxglove.COMPRESSED)
IMAGE_KINDS = ("sensor_msgs/msg/Image", *foxglove.IMAGES, *COMPRESSED_KINDS)
CAMERA_KINDS = ("sensor_msgs/msg/CameraInfo", *foxglove.CAMERAS)
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_PIXELS = {"16uc1": "u2", "mono16": "u2", "16sc1": "i2", "32sc1": "i4", "32fc1": "f4", "64fc1": "f8", "8uc1": "u1"}
_PIXELS |= {"mono8": "u1", "z16": "u2"}
_VECTOR = re.compile(r"((?:n|normals?|v|vel|velocity)[_.]?)([xyz])", re.IGNORECASE)
_JPEG = b"\xff\xd8\xff"
_DEPTH_HEADER = struct.Struct("<iff")  # of image_transport's compressedDepth, before the depth: format, two numbers


def cloud_of_message(path: Path, content: Any, keep: tuple[str, ...] = ()) -> Cloud:
    """Returns the points of a PointCloud2 or of a Livox scan, with colors where it has them, and the fields ``keep`` beside.

    Raises DataError when it holds fewer bytes than it says, or no x, y, z.
    """
    if isinstance(content, LivoxScan):
        return cloud_of_columns(path, content.columns, keep)
    order = ">" if content.is_bigendian else "<"
    fields: dict[str, Any] = {}
    for field in content.fields:
        if field.datatype in _POINT_TYPES and field.count in (0, 1):
            fields.setdefault(field.name, field)
    step, width, height = int(content.point_step), int(content.width), int(content.height)
    ends = [field.offset + np.dtype(_POINT_TYPES[field.datatype]).itemsize for field in fields.values()]
    data = np.frombuffer(memoryview(content.data), np.uint8)
    if not (width * height or len(data)):  # some nodes send no fields where they found nothing
        return Cloud(np.zeros((0, 3), np.float32), extra={name: np.zeros(0, np.float32) for name in keep})
    row_step = int(content.row_step) or width * step
    if max(ends, default=0) > step or width * step > row_step or len(data) < row_step * height:
        raise DataError(
            f"{path}: a cloud of {width} x {height} points of {step} bytes, rows of {row_step}, has {len(data)} bytes;"
            " the message is damaged"
        )
    kind = np.dtype(
        {
            "names": list(fields),
            "formats": [order + _POINT_TYPES[field.datatype] for field in fields.values()],
            "offsets": [field.offset for field in fields.values()],
            "itemsize": step,
        }
    )
    rows = data[: row_step * height].reshape(height, row_step)[:, : width * step]
    points = np.ascontiguousarray(rows).reshape(-1).view(kind)
    columns = {name: points[name].astype(points[name].dtype.newbyteorder("=")) for name in fields}
    motion = getattr(content, "pose", None)  # of Foxglove's clouds: to the frame in which they lie
    if motion is not None and not np.array_equal(motion[:3, :3], np.eye(3)):
        _turn_vectors(path, columns, motion[:3, :3], keep)
    cloud = cloud_of_columns(path, columns, keep)
    others = [field.name for field in content.fields if fields.get(field.name) is not field]
    cloud.unread += tuple(f"{name} (again)" if name in fields else name for name in others)
    beyond = (len(data) - row_step * height) // max(step, 1)
    cloud.dropped |= {BEYOND: beyond} if beyond else {}
    if motion is not None:
        with np.errstate(invalid="ignore", over="ignore"):  # of numbers that aren't finite, which are dropped
            moved = cloud.points @ motion[:3, :3].T + motion[:3, 3]
        cloud.points = np.where((cloud.points != 0).any(1, keepdims=True), moved, 0)  # at the origin nothing was seen
    return cloud


def _turn_vectors(path: Path, columns: dict[str, np.ndarray], turn: np.ndarray, keep: tuple[str, ...]) -> None:
    """Turns the normals and velocities of ``keep`` among columns by a rotation f64 (3,3), as their points are.

    Raises DataError where one lacks its other two parts, without which it can't be turned.
    """
    kept = [found for name in keep if name in columns and (found := _VECTOR.fullmatch(name))]
    for stem, axes in sorted({(found[1], "XYZ" if found[2].isupper() else "xyz") for found in kept}):
        names = [stem + axis for axis in axes]
        if lacking := [name for name in names if name not in columns]:
            raise DataError(
                f"{path}: a cloud's pose turns its points, and can't turn {first_names(names, 3)} with them, since the"
                f" message has no {' and no '.join(lacking)}; leave them out of --keep-fields"
            )
        with np.errstate(invalid="ignore", over="ignore"):  # of numbers that aren't finite
            turned = np.stack([columns[name].astype(np.float64) for name in names], axis=1) @ turn.T
        columns |= dict(zip(names, turned.T))


def depth_of_message(path: Path, kind: str, content: Any) -> np.ndarray:
    """Returns the depth of an Image or CompressedImage, (H,W) as stored. Raises DataError that names its encoding."""
    if kind in COMPRESSED_KINDS:
        return _compressed_depth(path, str(content.format), bytes(memoryview(content.data)))
    encoding = str(content.encoding).lower()
    if encoding not in _PIXELS:
        raise DataError(
            f"{path}: images of encoding {content.encoding!r}; expected depth: 16UC1, mono16 or 32FC1; choose its --topic"
        )
    pixel = np.dtype((">" if content.is_bigendian else "<") + _PIXELS[encoding])
    height, width = int(content.height), int(content.width)
    row = int(content.step) or width * pixel.itemsize
    data = np.frombuffer(memoryview(content.data), np.uint8)
    if len(data) < row * height or row < width * pixel.itemsize:
        raise DataError(f"{path}: an image of {width}x{height} {content.encoding} has {len(data)} bytes; it is damaged")
    rows = data[: row * height].reshape(height, row)[:, : width * pixel.itemsize]
    return np.ascontiguousarray(rows).view(pixel).astype(pixel.newbyteorder("="))


def _compressed_depth(path: Path, form: str, data: bytes) -> np.ndarray:
    encoding, _, method = (part.strip().lower() for part in form.partition(";"))
    if "compresseddepth" not in method:
        return _decoded(path, form, data)
    if len(data) < _DEPTH_HEADER.size:
        raise DataError(f"{path}: a compressed depth image of {len(data)} bytes; it is damaged")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    packed = data[_DEPTH_HEADER.size :]
    stored = unpack_rvl(path, packed) if "rvl" in method else _decoded(path, form, packed)
    if encoding != "32fc1":
        return stored
    with np.errstate(divide="ignore", invalid="ignore"):  # the inverse of depth was stored, 0 where nothing was seen
        return np.where(stored > 0, a / (stored.astype(np.float32) - b), 0).astype(np.float32)


def _decoded(path: Path, form: str, data: bytes) -> np.ndarray:
    image = decode_picture(data, path)
    if image is None:
        raise DataError(f"{path}: a compressed image ({form!r}) can't be decoded; it is damaged or of another kind")
    if image.ndim != 2 or data.startswith(_JPEG):
        what = "colored" if image.ndim != 2 else "JPEG, which holds no depth"
        raise DataError(f"{path}: compressed images ({form!r}) are {what}; expected depth; choose its --topic")
    return image


def calibration_of_message(path: Path, topic: str, content: Any, lens_model: str = "") -> Calibration | None:
    """Returns the camera of a CameraInfo for the images of ``topic``; None when it says that it isn't calibrated.

    lens_model: of its lens, "" for the one that it tells.
    For rectified images (``rect`` in the name of the topic) its projection P counts, else its K and lens.
    """
    # ROS 1 has them in capitals
    matrix, lens, projection = ([float(v) for v in _either(content, name)] for name in ("k", "d", "p"))
    rectified = "rect" in topic.rpartition("/")[2] or "rect" in topic.split("/")[-2:][0]
    numbers = (
        [projection[k] for k in (0, 5, 2, 6)] if rectified and any(projection) else [matrix[k] for k in (0, 4, 2, 5)]
    )
    if numbers[0] <= 0 or numbers[1] <= 0:
        return None
    roi = content.roi  # a cut-out of the picture that the numbers are for; none where its size is 0
    numbers[2:] = numbers[2] - roi.x_offset, numbers[3] - roi.y_offset
    bent = () if rectified else lens_coefficients(path, lens_model or str(content.distortion_model), lens)
    camera = LensIntrinsics(*numbers, bent) if bent else Intrinsics(*numbers)
    size = int(roi.width or content.width), int(roi.height or content.height)
    return Calibration(camera, *size, source=f"{path}: camera_info")


def _either(content: Any, name: str) -> Any:
    return getattr(content, name) if hasattr(content, name) else getattr(content, name.upper())
