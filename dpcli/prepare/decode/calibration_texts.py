"""Calibrations in dialects of their own: OpenCV's XML, MATLAB's toolboxes, and the INI of ROS's calibrator, as mappings."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from dpcli.errors import DataError

_MOST_BYTES = 1 << 20
_DEEPEST = 5  # entries within one another
_ROW = r"[ \t]*\n\s*".join([r"[-+.\deE \t]+"] * 3)
_OST_MATRIX = re.compile(rf"^camera matrix\s*\n\s*({_ROW})", re.MULTILINE | re.IGNORECASE)
_OST_LINE = re.compile(r"^(width|height|distortion)\s*\n([-+.\deE \t]+)$", re.MULTILINE | re.IGNORECASE)
_BOUGUET = re.compile(r"^\s*(fc|cc|kc|alpha_c|nx|ny)\s*=\s*\[?([^\];%\n]*(?:;[^\];%\n]*)*)", re.MULTILINE)
MATLAB_ADVICE = (
    "is a MATLAB file, whose cameras are objects that only MATLAB reads; save the matrix as text, from 0:"
    " writematrix(params.K - [0 0 1; 0 0 1; 0 0 0], 'K.txt')"
)


def mapping_of_xml(path: Path, text: str) -> dict[str, Any]:
    """Returns what OpenCV's ``FileStorage`` wrote as XML, matrices as ``{"data": [..]}``.

    Raises DataError of other XML, and of what declares entities, which may grow without end.
    """
    from xml.etree import ElementTree

    if len(text) > _MOST_BYTES or "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise DataError(f"{path}: too large for a calibration, or declares entities; expected XML as OpenCV writes it")
    try:
        root = ElementTree.fromstring(re.sub(r"^\s*<\?xml.*?\?>", "", text, flags=re.DOTALL))
    except (ElementTree.ParseError, RecursionError) as error:
        raise DataError(f"{path}: is not XML ({error})") from None
    if root.tag != "opencv_storage":
        raise DataError(f"{path}: XML of <{root.tag:.40}>; expected <opencv_storage>, as OpenCV writes calibrations")
    return {node.tag: _of_node(node) for node in root}


def _of_node(node: Any, depth: int = 0) -> Any:
    """Returns a matrix, a mapping of the entries below, a list of numbers, a number, or the text."""
    data = node.find("data")
    if data is not None:
        numbers = numbers_in(data.text or "")
        return {"data": data.text or "" if numbers is None else numbers}
    if len(node) and depth < _DEEPEST:
        return {child.tag: _of_node(child, depth + 1) for child in node}
    return _number_or_text(node.text or "")


def _number_or_text(text: str) -> Any:
    numbers = numbers_in(text)
    return text.strip().strip('"') if numbers is None else numbers[0] if len(numbers) == 1 else numbers


def mapping_of_ini(text: str) -> dict[str, Any] | None:
    """Returns what the INI of ROS's ``camera_calibration`` says, None of other texts."""
    matrix = _OST_MATRIX.search(text)
    if matrix is None:
        return None
    found: dict[str, Any] = {name.lower(): numbers_in(value) for name, value in _OST_LINE.findall(text)}
    sides = {name: value[0] for name, value in found.items() if value and name != "distortion"}
    return {"camera_matrix": numbers_in(matrix[1]), "d": found.get("distortion"), **sides}


def mapping_of_bouguet(text: str) -> dict[str, Any] | None:
    """Returns what ``Calib_Results.m`` of Bouguet's toolbox for MATLAB says, which counts pixels from 0; None of other texts."""
    found = {name: numbers_in(value.replace(";", " ").replace(",", " ")) for name, value in _BOUGUET.findall(text)}
    if any(len(found.get(name) or ()) != 2 for name in ("fc", "cc")):
        return None
    told: dict[str, Any] = dict(zip(("fx", "fy", "cx", "cy"), (*found["fc"], *found["cc"])))  # type: ignore[misc]
    told |= {"d": found.get("kc"), "skew": (found.get("alpha_c") or [0.0])[0]}
    return told | {side: found[key][0] for key, side in (("nx", "width"), ("ny", "height")) if found.get(key)}  # type: ignore[index]


def without_matlab_counting(data: dict[str, Any]) -> dict[str, Any]:
    """Returns the names and numbers of MATLAB's ``cameraParameters`` (``toStruct``) as other tools have them: pixels count
    from 0, and the size is width and height. Other mappings stay as they are.
    """
    own = lower_keys(data)
    if "radialdistortion" not in own or not ({"focallength", "intrinsicmatrix", "k"} & set(own)):
        return data
    told = {key: own[key] for key in ("skew", "radialdistortion", "tangentialdistortion") if key in own}
    matrix = own.get("k") or own.get("intrinsicmatrix")
    if isinstance(matrix, list) and len(matrix) == 3 and all(isinstance(row, list) and len(row) == 3 for row in matrix):
        across = matrix if any((matrix[0][2], matrix[1][2])) else [list(row) for row in zip(*matrix)]
        focal, center = (across[0][0], across[1][1]), (across[0][2], across[1][2])
    else:
        focal, center = own.get("focallength"), own.get("principalpoint")
    try:
        (told["fx"], told["fy"]), (cx, cy) = focal, center
        told |= {"cx": float(cx) - 1, "cy": float(cy) - 1}
    except (TypeError, ValueError):
        return data
    size = own.get("imagesize")
    return told | (dict(zip(("height", "width"), size)) if isinstance(size, list) and len(size) == 2 else {})


def lower_keys(mapping: dict[Any, Any]) -> dict[str, Any]:
    """Returns the mapping with its own keys in small letters."""
    return {str(key).lower(): value for key, value in mapping.items()}


def numbers_in(text: str) -> list[float] | None:
    """Returns the numbers of a text that holds nothing else, None of another one."""
    try:
        return [float(word) for word in text.split()] or None
    except ValueError:
        return None
