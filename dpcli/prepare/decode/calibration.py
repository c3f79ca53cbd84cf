"""Calibration files of depth cameras, as many tools write them: focal lengths, image size, lens, and depth units.

Whatever a file declares is used, or refused by its name.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.npy_files import map_npy
from dpcli.prepare.cloud_formats.column_names import unit_of
from dpcli.prepare.decode.calibration_texts import (
    MATLAB_ADVICE,
    lower_keys,
    mapping_of_bouguet,
    mapping_of_ini,
    mapping_of_xml,
    numbers_in,
    without_matlab_counting,
)
from dpcli.prepare.decode.lenses import MODEL, are_numbers, first, is_lens, lens_of_mapping, letters, require_pinhole
from dpcli.prepare.decode.pinhole_camera import OF_COLORS, Calibration, Intrinsics, KinectCalibration, LensIntrinsics
from dpcli.store.schema import METERS
from dpcli.text_files import check_depth, decode_text, parse_json

_FX, _FY = ("fx", "fl_x", "f_x", "fx_depth"), ("fy", "fl_y", "f_y", "fy_depth")
_CX = ("cx", "ppx", "c_x", "mx_depth")
_CY = ("cy", "ppy", "c_y", "my_depth")
_MATRIX = ("intrinsic_matrix", "camera_matrix", "k", "intrinsic", "intrinsics", "intrinsicmatrix", "cameramatrix")
_MATRIX += ("m_calibrationdepthintrinsic", _BOP := "cam_k")  # of ScanNet's recordings, and of BOP's scenes
_SIZE_OF = (
    "^(m|camera|cam|sensor)?(depth|ir|image|img|picture|frame|resolution|{})*"  # and before the names of both sides
)
_SIDES = ("(width|w|cols|columns)$", "(height|h|rows)$")
_SIZE = re.compile("^(depth|image|img|frame|picture|camera)*(size|resolution|dimensions?|shape)$")
_ASPECT = 1.5  # of the focal lengths, beyond which other numbers are meant
_SCALE = re.compile(  # a key of the depth scale without what is no letter, and the unit that it may end with
    r"(?:m|png|raw|integer|sensor|camera)?depth(?:map|image|raw|pixel)?(?:scal(?:e|ing)|units?|factor|shift|to(?=m))+"
    r"(per|in|to)?(mm|millimet(?:er|re)s?|cm|um|m|met(?:er|re)s?)?"
)
_OF_SLAM = re.compile(r"^(Camera1?|RGBD)\.(?!.*bf)")  # before the names that ORB-SLAM and its kind write
_ABOUT_CAMERAS = "projection|dist(?:ortions?)?|intrinsics?|coefficients?|coeffs?|params?|parameters?|camera|cam|matrix"
_COLMAP = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
}  # how many parameters
_KINECT_SENSOR = 1024  # pixels of a side
_DEEPEST = 6  # entries within one another
_FEWEST_TERMS = 4  # of a lens
_MOST_NUMBERS = 64  # in an array
_MOST_PIXELS = 1_000_000  # of a side of a picture
_EXPECTED = (
    'expected {"fx": .., "fy": .., "cx": .., "cy": ..} in pixels, a 3x3 or 4x4 matrix, or what RealSense, Open3D, ROS or'
    " COLMAP write"
)


def read_calibration(path: Path) -> Calibration:
    """Reads a calibration: JSON or YAML of RealSense, Open3D, ROS, OpenCV (XML, too), Kalibr, MATLAB (``toStruct`` as JSON,
    Bouguet's ``.m``), ScanNet's 4x4 text, COLMAP's ``cameras.txt``, ``key = value`` lines, or a matrix in ``.npy`` or text;
    row- or column-major.

    Raises DataError that names what the file lacks, or declares and can't be used.
    """
    if path.suffix.lower() == ".npy":
        return _of_numbers(path, _load_npy(path))
    if path.suffix.lower() == ".mat" and path.is_file():
        raise DataError(f"{path}: {MATLAB_ADVICE}")
    try:
        text = decode_text(path)
    except DataError:
        hint = "; of COLMAP's cameras.bin `colmap model_converter --output_type TXT` makes cameras.txt"
        raise DataError(f"{path}: is not text; {_EXPECTED}{hint if path.suffix == '.bin' else ''}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    if (cameras := _colmap_lines(text)) and path.suffix.lower() == ".txt":
        return _of_colmap(path, cameras)
    numbers = _only_numbers(text)
    names = re.findall(r"\w+", text[1 : text.find("\n")]) if text.startswith("#") else []
    if numbers is not None and "fx" in names and len(names) == len(numbers):
        return _of_mapping(path, dict(zip(names, numbers)))
    if numbers is not None:
        return _of_numbers(path, numbers)
    return _of_mapping(path, _parsed(path, text))


def camera_of_arrays(
    path: Path, arrays: dict[str, np.ndarray], frames: int, *, with_camera: bool
) -> tuple[Calibration | None, float | None, tuple[str, ...]]:
    """Returns the camera and the raw units per meter that small arrays beside those of so many frames of depth tell, None where
    they don't, and the names of the arrays that tell nothing of these. with_camera: whether the camera is asked for.
    """
    arrays, apart = _of_all_frames(arrays, frames)
    small = {name: array for name, array in arrays.items() if array.size <= _MOST_NUMBERS and array.ndim <= 2}
    told = {k.lower(): v.item() if v.size == 1 else v.tolist() for k, v in small.items() if v.dtype.kind in "uifU"}
    known = _holds_camera(told)
    camera = _of_mapping(path, told) if known and with_camera else None
    scale = camera.depth_scale if camera else _depth_scale(path, told, {})
    about = (*_MATRIX, *_FX, *_FY, *_CX, *_CY, *MODEL, "width", "height") if known else ()
    unread = [k for k in arrays if k.lower() not in about and not _is_scale(k.lower())]
    return camera, scale, (*(k for k in unread if not (known and is_lens(k.lower()))), *apart)


def _of_all_frames(arrays: dict[str, np.ndarray], frames: int) -> tuple[dict[str, np.ndarray], list[str]]:
    """Returns arrays with the camera of the first frame where one of each frame is told and all are equal, and what is said of
    those that differ, which aren't among them.
    """
    found, apart = {}, []
    for name, array in arrays.items():
        several = (
            frames > 1
            and array.ndim
            and len(array) == frames
            and array.shape not in ((3, 3), (4, 4), (3, 4), (4,), (9,))
        )
        if not several or name.lower() not in (*_MATRIX, *_FX, *_FY, *_CX, *_CY):
            found[name] = array
        elif np.allclose(array, array[:1], rtol=1e-4):
            found[name] = array[0]
        else:
            apart.append(f"{name}, which differs from frame to frame")
    return found, apart


def camera_of_any(
    path: Path,
    further: Sequence[dict[str, np.ndarray]],
    arrays: dict[str, np.ndarray],
    frames: int,
    *,
    with_camera: bool,
) -> tuple[tuple[Calibration | None, float | None, tuple[str, ...]], dict[str, np.ndarray]]:
    """Returns what `camera_of_arrays` does of arrays and the first of some further ones that contradict neither them nor each
    other, and these. Raises DataError where the last do, too.
    """
    for more in further[:-1]:
        with suppress(DataError):
            return camera_of_arrays(path, {**more, **arrays}, frames, with_camera=with_camera), more
    return camera_of_arrays(path, {**further[-1], **arrays}, frames, with_camera=with_camera), further[-1]


def _parsed(path: Path, text: str) -> dict[str, Any]:
    suffix = path.suffix.lower()
    data: Any
    if suffix in (".yaml", ".yml"):
        data = _yaml(path, text)
    elif suffix == ".xml" or text.lstrip().startswith("<"):
        data = mapping_of_xml(path, text)
    elif suffix in (".ini", ".txt", ".m") and (told := mapping_of_ini(text) or mapping_of_bouguet(text)):
        data = told
    elif suffix == ".json" or text.lstrip().startswith(("{", "[{")):
        data = parse_json(text, path)
    else:
        data = _of_lines(path, text)
    if not isinstance(data, dict):
        raise DataError(f"{path}: {_EXPECTED}")
    return data


def _of_lines(path: Path, text: str) -> dict[str, Any]:
    """Returns what lines of ``key = value`` say, or a row of names and one of values. Raises DataError where two lines differ."""
    lines = [re.split(r"\s*[=:]\s*", line.strip(), maxsplit=1) for line in text.splitlines()]
    pairs = [(pair[0], _number_or_text(pair[1])) for pair in lines if len(pair) == 2]
    sign = next((sign for sign in ";\t," if sign in text), None)  # beside the first two commas are decimal ones
    rows = [[cell.strip() for cell in line.split(sign)] for line in text.splitlines() if line.strip()]
    if not pairs and len(rows) == 2 and len(rows[0]) == len(rows[1]):
        points = [value if sign == "," else value.replace(",", ".") for value in rows[1]]
        pairs = [(name.strip('"'), _number_or_text(value.strip('"'))) for name, value in zip(rows[0], points)]
    data = dict(pairs)
    twice = next((name for name, value in pairs if data[name] != value), None)
    if twice:
        raise DataError(
            f"{path}: says {twice} twice, with different values; expected the lines of the depth camera alone"
        )
    return data


def _yaml(path: Path, text: str) -> Any:
    import yaml

    plain = re.sub(r"^%YAML.*$|!!opencv-(nd-)?matrix", "", text, flags=re.MULTILINE)
    try:
        data = next((part for part in yaml.safe_load_all(plain) if part), None)
    except RecursionError:
        raise DataError(f"{path}: nested deeper than any calibration") from None
    except yaml.YAMLError as error:
        raise DataError(f"{path}: is not YAML ({' '.join(str(error).split())})") from None
    check_depth(data, path)
    return {_OF_SLAM.sub("", str(key)): value for key, value in data.items()} if isinstance(data, dict) else data


def _number_or_text(text: str) -> Any:
    """Returns the number that a text holds, the list of its numbers where it holds four or more, else the text itself."""
    numbers = numbers_in(text.rstrip("; ").replace(",", " ")) or ()
    return numbers[0] if len(numbers) == 1 else numbers if len(numbers) >= _FEWEST_TERMS else text


def _with_numbers(data: Any) -> Any:
    """Returns what a file holds with the numbers that stand in quotes as numbers."""
    if isinstance(data, dict):
        return {key: _with_numbers(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_with_numbers(value) for value in data]
    return _number_or_text(data) if isinstance(data, str) else data


def _load_npy(path: Path) -> list[float]:
    array = map_npy(path)
    if array.size > _MOST_NUMBERS:
        raise DataError(f"{path}: {array.size} numbers; {_EXPECTED}")
    try:
        return [float(value) for value in array.reshape(-1)]
    except (ValueError, TypeError) as error:
        raise DataError(f"{path}: not a readable .npy array ({error})") from None


def _only_numbers(text: str) -> list[float] | None:
    """Returns the numbers of a text that holds nothing else but brackets and separators, None of another one."""
    kept = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    return numbers_in(re.sub(r"[\[\](),;]", " ", "\n".join(kept)))


def _of_numbers(path: Path, numbers: list[float]) -> Calibration:
    if len(numbers) in (4, 6) and max(numbers[-4:-2]) > _ASPECT * abs(min(numbers[-4:-2])):
        raise DataError(
            f"{path}: focal lengths {numbers[-4]:g} and {numbers[-3]:g}; expected fx fy cx cy, in this order"
        )
    if len(numbers) == 4:
        return Calibration(_intrinsics(path, numbers, ()), source=str(path))
    if len(numbers) == 6:  # ARKit's .pincam: the size first
        size = _pixel_counts(path, *numbers[:2])
        return Calibration(_intrinsics(path, numbers[2:], ()), *size, source=str(path))
    return Calibration(_intrinsics(path, _of_matrix(path, numbers), ()), source=str(path))


def _of_matrix(path: Path, values: Any) -> list[float]:
    """Returns fx, fy, cx, cy of a matrix of 3x3, 3x4 or 4x4 numbers, row- or column-major, as lists or one list."""
    try:
        flat = np.asarray(values, np.float64).reshape(-1)
        matrix = flat.reshape({9: (3, 3), 12: (3, 4), 16: (4, 4)}[flat.size])[:3, :3]
    except (KeyError, ValueError, TypeError, OverflowError):
        raise DataError(f"{path}: its matrix is not of 3x3 or 4x4 numbers; {_EXPECTED}") from None
    if not matrix[:2, 2].any() and matrix[2, :2].any():  # the principal point in the last row: column by column
        matrix = matrix.T
    if matrix[1, 0] or matrix[2, 0] or matrix[2, 1] or matrix[2, 2] != 1:
        raise DataError(f"{path}: its matrix is not fx 0 cx, 0 fy cy, 0 0 1, by rows or by columns; {_EXPECTED}")
    if abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise DataError(f"{path}: its matrix has a skew of {matrix[0, 1]:g}; expected pixels that are rectangles")
    return [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]


def _intrinsics(path: Path, numbers: list[float], lens: tuple[float, ...]) -> Intrinsics:
    try:
        return LensIntrinsics(*numbers, lens) if any(lens) else Intrinsics(*numbers)
    except UsageError as error:
        raise DataError(f"{path}: {error}") from None


def _colmap_lines(text: str) -> list[list[str]]:
    """Returns the words of lines such as ``1 PINHOLE 640 480 525 525 320 240``."""
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return (
        lines
        if lines and all(len(words) > 4 and words[1].isupper() and words[1][0].isalpha() for words in lines)
        else []
    )


def _of_colmap(path: Path, cameras: list[list[str]]) -> Calibration:
    if len({tuple(words[1:]) for words in cameras}) > 1:
        raise DataError(f"{path}: holds {len(cameras)} different cameras; expected the line of the depth camera alone")
    words = cameras[0]
    model = words[1]
    if len(words) != 4 + _COLMAP.get(model, -1):
        raise DataError(f"{path}: camera model {model}; expected one of {', '.join(_COLMAP)}, with its parameters")
    try:
        width, height, *values = (float(word) for word in words[2:])
    except ValueError:
        raise DataError(f"{path}: {' '.join(words)!r}: expected numbers after the model") from None
    if model.startswith("SIMPLE") or model == "RADIAL":
        values = [values[0], *values]
    fx, fy, cx, cy, *lens = values
    lens += [0.0] * (-len(lens) % 4)  # k1, or k1 and k2, without p1 and p2, which OpenCV wants beside them
    corner = [fx, fy, cx - 0.5, cy - 0.5]  # COLMAP counts from the corner of the first pixel, not from its center
    return Calibration(_intrinsics(path, corner, tuple(lens)), *_pixel_counts(path, width, height), source=str(path))


def _of_mapping(path: Path, data: dict[str, Any]) -> Calibration:
    if "CalibrationInformation" in data:
        return kinect_calibration(path, data["CalibrationInformation"])
    data = without_matlab_counting(_with_numbers(data))
    chosen, own = _camera_of(path, data)
    if are_numbers([own.get("skew", 0)]) and own.get("skew"):
        raise DataError(f"{path}: declares a skew of {own['skew']:g}; expected pixels that are rectangles")
    lens = lens_of_mapping(path, own)
    numbers = _pixels(path, own)
    size = _resolution(path, own, numbers[2:])
    roi = own.get("roi")  # of ROS: what is cut out of the picture that the numbers are for; none where its size is 0
    cut = [roi.get(key) for key in ("x_offset", "y_offset", "width", "height")] if isinstance(roi, dict) else []
    if cut and are_numbers(cut) and all(cut[2:]):
        numbers[2:], size = [numbers[2] - cut[0], numbers[3] - cut[1]], _pixel_counts(path, *cut[2:])
    scale = _depth_scale(path, own, data)
    return Calibration(_intrinsics(path, numbers, lens), *size, scale, str(path), chosen)


def kinect_calibration(path: Path, told: Any) -> Calibration:
    """Returns the depth camera of an Azure Kinect from the raw calibration that its SDK attaches to recordings: shares of the
    sensor from its corner, and a rational lens whose p2 stands before p1. Raises DataError where it holds none.
    """
    cameras = told.get("Cameras") if isinstance(told, dict) else None
    cameras = [one for one in cameras if isinstance(one, dict)] if isinstance(cameras, list) else []
    depth = next((one for one in cameras if one.get("Location") == "CALIBRATION_CameraLocationD0"), {})
    lens = depth.get("Intrinsics") if isinstance(depth.get("Intrinsics"), dict) else {}
    shares, side = lens.get("ModelParameters"), _KINECT_SENSOR
    known = isinstance(shares, list) and len(shares) >= 14 and are_numbers(shares) and not any(shares[10:12])
    sizes = (depth.get("SensorWidth"), depth.get("SensorHeight"))
    if not known or sizes != (side, side) or not str(lens.get("ModelType")).endswith("ModelBrownConrady"):
        raise DataError(
            f"{path}: is the raw calibration of an Azure Kinect without a depth camera of {side}x{side} and model BrownConrady;"
            f" {_EXPECTED}, as the camera's SDK reports them for the depth mode"
        )
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = shares[:14]
    numbers = [fx * side, fy * side, cx * side - 0.5, cy * side - 0.5]
    return KinectCalibration(_intrinsics(path, numbers, (k1, k2, p1, p2, k3, k4, k5, k6)), side, side, source=str(path))


def attached_calibration(path: Path, text: bytes) -> Calibration:
    """Returns the camera of a calibration in JSON that is attached to a video. Raises DataError where it can't be used."""
    source = path / "calibration.json"
    return _of_mapping(source, _parsed(source, text.decode("utf-8", "replace").rstrip("\0")))


def _camera_of(path: Path, data: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Returns the mapping that holds intrinsics, in small letters: the whole, the only one, one of several that are equal, or the
    part of the depth camera; before it its name where others differ, or where that says that it is of colors.
    """
    found = list(_cameras("", data, {}))
    if not found:
        require_pinhole(path, {str(key).lower(): value for key, value in data.items()})
        raise DataError(f"{path}: {_EXPECTED}")
    if len(found) == 1 or found[0][0] == "":
        return (found[0][0] if OF_COLORS.search(found[0][0]) else ""), found[0][1]
    depth = [(name, part) for name, part in found if re.search("depth|(^|/)ir($|/)", name, re.IGNORECASE)]
    alike = depth or found
    if all(_same_camera(path, part, alike[0][1]) for _, part in alike[1:]):
        return ("" if len(alike) == len(found) else alike[0][0]), alike[0][1]
    names = ", ".join(name for name, _ in found[:5])
    raise DataError(f"{path}: holds several cameras ({names}); expected one, or one called depth")


def _same_camera(path: Path, part: dict[str, Any], other: dict[str, Any]) -> bool:
    """Returns whether two mappings hold one camera, as where a file repeats it for every frame."""
    return part == other or all(read(path, part) == read(path, other) for read in (_pixels, lens_of_mapping))


def _cameras(name: str, data: Any, outer: dict[str, Any], depth: int = 0) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields every mapping that holds intrinsics, with what is said around it, such as the size of the pictures."""
    if depth == _DEEPEST:
        return
    if isinstance(data, dict):
        own = lower_keys(data)
        around = {**outer, **{key: value for key, value in own.items() if not isinstance(value, dict)}}
        if _holds_camera(own):
            yield name, {**outer, **own}
        for key, value in data.items():
            beside = [other for said, other in data.items() if _is_lens_of(str(said), str(key))]
            lens = {"distortion": beside[0]} if beside else {}
            yield from _cameras(f"{name}/{key}".lstrip("/"), value, {**around, **lens}, depth + 1)
    elif isinstance(data, list):
        for place, value in enumerate(data):
            yield from _cameras(f"{name}/{place}", value, outer, depth + 1)


def _is_lens_of(key: str, camera: str) -> bool:
    """Returns whether a key says that it holds the lens of the camera beside it: ``depthDistortion`` of ``depthIntrinsic``."""
    if not re.search("dist(?!an)", key, re.IGNORECASE):
        return False
    plain = [re.sub(_ABOUT_CAMERAS, "", re.sub("[^a-z]", "", word.lower())) for word in (key, camera)]
    return plain[0] == plain[1]


def _holds_camera(part: dict[str, Any]) -> bool:
    matrix = first(part, _MATRIX)
    listed = isinstance(matrix, list) and not any(isinstance(one, dict) for one in matrix)
    holds_matrix = listed or (isinstance(matrix, dict) and "data" in matrix)
    return holds_matrix or any(key in part for key in (*_FX, *_CX))


def _pixels(path: Path, own: dict[str, Any]) -> list[float]:
    matrix = first(own, _MATRIX)
    if isinstance(matrix, dict):
        matrix = matrix.get("data")
    if isinstance(matrix, list):
        return [float(v) for v in matrix] if len(matrix) == 4 and are_numbers(matrix) else _of_matrix(path, matrix)
    values = [first(own, names) for names in (_FX, _FY, _CX, _CY)]
    if not are_numbers(values):
        raise DataError(f"{path}: {_EXPECTED}")
    return [float(value) for value in values]


def _resolution(path: Path, own: dict[str, Any], center: list[float]) -> tuple[int, int]:
    """Returns width and height of the pictures, 0 where nothing tells them. Two numbers of one entry stand in the order that
    puts the principal point ``center`` nearer to the middle.
    """
    size = next((value for key, value in own.items() if _SIZE.match(letters(key))), None)
    if isinstance(size, dict) and "data" in size:  # OpenCV's lists
        size = size["data"]
    if isinstance(size, dict):
        return _resolution(path, lower_keys(size), center)
    if isinstance(size, str):
        size = [float(number) for number in re.findall(r"\d+", size)]
    pair = size if isinstance(size, list) and len(size) == 2 else _sides(own)
    if not are_numbers(pair) or any(value <= 0 for value in pair):
        return 0, 0
    turned = size is pair and _off_middle(center, pair[::-1]) < _off_middle(center, pair)
    return _pixel_counts(path, *(pair[::-1] if turned else pair))


def _sides(own: dict[str, Any]) -> list[Any]:
    """Returns the width and the height that a mapping names, those of the color camera only where there are no others."""
    for other in ("-", "color|rgb"):
        found = []
        for side in _SIDES:
            known = re.compile(_SIZE_OF.format(other) + side)
            keys = sorted((key for key in own if known.match(letters(key)) and own[key] is not None), key=len)
            found.append(own[keys[0]] if keys else None)
        if None not in found:
            return found
    return [None, None]


def _off_middle(center: list[float], size: list[float]) -> float:
    return sum(abs((at + 0.5) / side - 0.5) for at, side in zip(center, size) if side > 0)


def _pixel_counts(path: Path, width: float, height: float) -> tuple[int, int]:
    if not 0 < width <= _MOST_PIXELS or not 0 < height <= _MOST_PIXELS:
        raise DataError(
            f"{path}: pictures of {str(width):.20} x {str(height):.20} pixels; expected 1 to {_MOST_PIXELS:,} a side"
        )
    return int(width), int(height)


def _depth_scale(path: Path, own: dict[str, Any], whole: dict[str, Any]) -> float | None:
    """Returns raw units per meter; small values are meters per unit, as RealSense has them.

    Raises DataError where what is said is no scale, or two scales differ.
    """
    said = [{k: v for k, v in part.items() if _is_scale(k) and v is not None} for part in (own, lower_keys(whole))]
    found = said[0] or said[1]
    if not found and "scale" in own and "fx" in own:  # as mappers of rooms write it
        found = {"depth_scale": own["scale"]}
    millimeters = _BOP in own  # are what it multiplies raw depths to
    scales = {
        key: _units_per_meter(path, f"{key}_in_mm" if millimeters else key, value) for key, value in found.items()
    }
    if scales and max(scales.values()) > 1.001 * min(scales.values()):
        raise DataError(
            f"{path}: {' and '.join(scales)} give different depth scales ({', '.join(f'{v:g}' for v in scales.values())} raw"
            " units per meter); expected one of them"
        )
    return next(iter(scales.values()), None)


def _is_scale(key: str) -> bool:
    return _SCALE.fullmatch(letters(key)) is not None


def _units_per_meter(path: Path, key: str, value: Any) -> float:
    """Returns the raw units per meter that a depth scale means. Its key may end with a unit, in which the value is then."""
    if isinstance(value, str) and (unit := unit_of(f"in {value}")):
        return 1 / METERS[unit]
    if not are_numbers([value]) or not value > 0:
        raise DataError(f"{path}: its depth scale is {value!r}; expected raw units per meter, or meters per raw unit")
    match = _SCALE.fullmatch(letters(key))
    if match and (unit := unit_of(f"in {match[2]}")):
        size = value * METERS[unit] if match[1] != "per" else METERS[unit] / value
        return float(f"{1 / size:.12g}")
    return float(value) if value >= 1 else float(f"{1 / value:.12g}")
