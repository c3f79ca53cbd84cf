"""Lenses that calibrations describe: the coefficients of Brown's models, which are undone; all others are refused by name."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.prepare.decode.calibration_texts import lower_keys

_COEFFICIENTS = re.compile(  # a key of a lens's coefficients without what is no letter
    r"d|kc|coeff(?:icient)?s|disto|(?:cam(?:era)?|lens|depth|ir)*dist(?:ort(?:ion)?)?"
    r"(?:coe?ff?(?:icient)?|param(?:eter)?|vec(?:tor)?|mat(?:rix)?|model)?s?"
)
_TERMS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # of a lens, in OpenCV's order
MODEL = ("model", "distortion_model", "camera_model", "cameramodel", "lens_model", "type")
_SAYS_MODEL = re.compile("model|type|projection|lens")  # in a key
_BROWN = ("", "brown_conrady", "plumb_bob", "rational_polynomial", "opencv", "full_opencv", "pinhole", "none")
_BROWN += ("radtan", "radial_tangential")
_NO_PINHOLE = re.compile(  # a model that bends lines even where its coefficients are 0
    r"fish_?eye|equi(dist|rect|_|$)|kannala|(^|_)kb\d?(_|$)|omni|(^|_)(mei|e?ucm|ds|f_?theta|fov)(_|$)|unified|double_sphere|spheric"
    r"|panoram|cylind|orthograph|scaramuzza"
)
_ADVICE = (
    ", of a fisheye or the like, which is not read; expected a pinhole camera: undistort the depth with the nearest pixel's"
    " value (as by cv2.fisheye.initUndistortRectifyMap and cv2.remap), and give the camera of the result"
)


def require_pinhole(path: Path, own: dict[str, Any]) -> None:
    """Raises DataError where a mapping, its keys in small letters, says that the camera is a fisheye, omnidirectional or the like."""
    mirror = own.get("mirror_parameters")  # of CamOdoCal
    for key, value in {**own, **(mirror if isinstance(mirror, dict) else {})}.items():
        told = value.get("data") if isinstance(value, dict) else value
        if isinstance(told, str):
            odd = _SAYS_MODEL.search(key) and _NO_PINHOLE.search(_plain(told))
        else:
            odd = (key == "xi" or "fisheye" in letters(key)) and np.any(told)
        if odd:
            raise DataError(
                f"{path}: its lens is of {'model' if isinstance(told, str) else key} {str(told):.40}{_ADVICE}"
            )


def _plain(model: str) -> str:
    return re.sub("[- ]", "_", model.lower().replace("distortion.", ""))


def first(part: dict[str, Any], names: tuple[str, ...]) -> Any:
    """Returns the first value that is there of those that names have."""
    return next((part[name] for name in names if part.get(name) is not None), None)


def are_numbers(values: list[Any]) -> bool:
    """Returns whether all values are numbers that a camera may have: neither NaN, infinite nor astronomical."""
    return all(
        isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e15 for value in values
    )


def letters(key: str) -> str:
    """Returns a key in small letters without what is no letter."""
    return re.sub("[^a-z]", "", key)


def lens_of_mapping(path: Path, own: dict[str, Any]) -> tuple[float, ...]:
    """Returns the coefficients k1 k2 p1 p2 k3 k4 k5 k6 of a lens, none where all are 0. Raises DataError for what isn't read."""
    require_pinhole(path, own)
    values = _coefficients(own)
    told = own.get("distortion")  # as RealSense's tools print it, or what stands beside the coefficients
    told = first(lower_keys(told), MODEL) if isinstance(told, dict) else told
    if isinstance(values, dict):
        listed = values.get("data", _coefficients(lower_keys(values)))
        values = _named_terms(path, values) if listed is None else listed
    if values is None and any(key in own for key in _TERMS):
        values = _named_terms(path, {key: own[key] for key in _TERMS if key in own})
    if values is None and (radial := own.get("radial_distortion", own.get("radialdistortion"))) is not None:
        bent = own.get("tangential_distortion", own.get("tangentialdistortion")) or [0.0, 0.0]
        values = [*radial[:2], *bent, *radial[2:]] if isinstance(radial, list) and isinstance(bent, list) else None
    flat = np.asarray(values if isinstance(values, list) else [], object).reshape(-1).tolist()
    if not are_numbers(flat):
        raise DataError(f"{path}: its lens has the coefficients {str(flat):.80}; expected numbers")
    return lens_coefficients(path, str((isinstance(told, str) and told) or first(own, MODEL) or ""), flat)


def is_lens(key: str) -> bool:
    """Returns whether a key, in small letters, says that it holds the coefficients of a lens."""
    return _COEFFICIENTS.fullmatch(letters(key)) is not None


def _coefficients(part: dict[str, Any]) -> Any:
    """Returns the list or mapping of a lens: the last, which stands nearest to the camera, but before all what isn't called
    ``distortion``, which may hold the model alone.
    """
    found = ((key, part[key]) for key in reversed(part) if is_lens(key))
    listed = {key: value for key, value in found if value and isinstance(value, (list, dict))}
    return listed[min(listed, key="distortion".__eq__)] if listed else None


def _named_terms(path: Path, terms: dict[str, Any]) -> list[Any]:
    """Returns the coefficients of a lens that a mapping names. Raises DataError at one that isn't known."""
    small = {str(key).lower(): value or 0.0 for key, value in terms.items()}
    told = {key: value for key, value in small.items() if key not in _TERMS and value}
    strange = [key for key, value in told.items() if are_numbers([value]) or isinstance(value, list) and any(value)]
    if strange:
        raise DataError(f"{path}: its lens has a coefficient {strange[0]}; expected {', '.join(_TERMS)} alone")
    return [small.get(key, 0.0) for key in (_TERMS if any(small.get(key) for key in _TERMS[5:]) else _TERMS[:5])]


def lens_coefficients(path: Path, name: str, flat: list[float]) -> tuple[float, ...]:
    """Returns the coefficients of a lens, none where all are 0. name: of its model.

    Raises DataError for a model that isn't read, whatever its coefficients are.
    """
    model = _plain(name)
    if _NO_PINHOLE.search(model):
        raise DataError(f"{path}: its lens is of model {model}{_ADVICE}")
    if not any(flat):
        return ()
    if model not in _BROWN or len(flat) not in (4, 5, 8, 12, 14):
        raise DataError(
            f"{path}: its lens is of model {model or 'unknown'} with {len(flat)} coefficients that aren't all 0; expected"
            " plumb_bob or rational_polynomial (k1 k2 p1 p2 k3 ...), or pictures that were rectified and no coefficients"
        )
    return tuple(float(value) for value in flat)
