"""Attributes of HDF5, and texts beside arrays, that tell their units and times."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

UNIT_NAMES = ("units", "unit", "length_unit")
_MODEL_NAMES = ("distortion_model", "camera_model", "lens_model", "model")  # of a lens
_LETTERS = 100  # of a text that tells a unit


def told_lengths(arrays: Mapping[str, Any], name: str) -> list[str]:
    """Returns what its own attribute says of the unit of an array, or else what attributes of its group, and of those above, and
    texts beside it say, as in ``savez(file, points=points, units="mm")``: the nearest first. These may tell of other things.
    """
    own = told_units(arrays[name])
    return [own] if own else told_beside(arrays, name)


def told_beside(arrays: Mapping[str, Any], name: str) -> list[str]:
    """Returns what `told_lengths` does of an array without an attribute of its own."""
    group, texts, found = name, getattr(arrays, "texts", {}), []
    holder: Any = getattr(arrays[name], "_dataset", arrays[name])
    while group:
        group, holder = group.rpartition("/")[0], getattr(holder, "parent", None)
        told = {} if holder is None else _read_attributes(holder)
        found += [_text_of(told[called]) for called in UNIT_NAMES if called in told]
        found += [texts[own] for called in UNIT_NAMES if (own := f"{group}/{called}".lstrip("/")) in texts]
    return found


def says_unit(name: str) -> bool:
    """Returns whether a text of this name tells a unit.

    >>> says_unit("walk/units"), says_unit("subunits")
    (True, False)
    """
    return name.rpartition("/")[2] in UNIT_NAMES


def says_text(name: str) -> bool:
    """Returns whether a text of this name is read: one that tells a unit, or the model of a camera's lens."""
    return says_unit(name) or name.rpartition("/")[2] in _MODEL_NAMES


def model_texts(found: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Returns the texts among some, or among attributes, that tell the model of a camera's lens, each as an array of one."""
    told = {name: one for name, one in found.items() if name.rpartition("/")[2] in _MODEL_NAMES}
    return {name: np.asarray(text) for name, one in told.items() if (text := _text_of(one))}


def told_units(array: Any) -> str:
    """Returns what the attribute ``units``, ``unit`` or ``length_unit`` of an HDF5 data set says, such as "mm" or "hours since
    2024-03-05"; "" without one.
    """
    attributes = getattr(array, "attrs", {})
    told = np.ravel(next((attributes[name] for name in UNIT_NAMES if name in attributes), "")).tolist()
    return " ".join(one.decode("latin-1") if isinstance(one, bytes) else str(one) for one in told)


def attributes_of(array: Any, *, above: bool = False) -> Mapping[str, Any]:
    """Returns the attributes of an HDF5 data set, and of its group where it has none of a name; none of other arrays. above: only
    those of the group that holds its group.
    """
    dataset = getattr(array, "_dataset", array)
    if not hasattr(dataset, "parent"):
        return {}
    return _read_attributes(dataset.parent.parent if above else dataset.parent, *([] if above else [dataset]))


def _read_attributes(*holders: Any) -> dict[str, Any]:
    """Returns the attributes of groups and data sets, those of the last first; without those whose type h5py can't read."""
    found = {}
    for holder in holders:
        for name in holder.attrs:
            with suppress(TypeError, ValueError, OSError):
                found[name] = holder.attrs[name]
    return found


def texts_about(items: Mapping[str, Any]) -> dict[str, str]:
    """Returns the texts that data sets of HDF5 hold which are read, by name."""
    return {name: _text_of(item) for name, item in items.items() if says_text(name)}


def _text_of(told: Any) -> str:
    """Returns the text that a data set holds, as letters or as MATLAB's numbers of these, or an attribute; "" of anything else."""
    letters, is_stored = False, hasattr(told, "attrs")
    if is_stored and (told.shape is None or told.size >= _LETTERS):
        return ""
    if is_stored:
        letters, told = told.attrs.get("MATLAB_class") == b"char", told[()]
    values = np.ravel(told)
    text = "".join(map(chr, values)) if letters else values.tolist()[0] if len(values) == 1 else ""
    return text.decode("latin-1") if isinstance(text, bytes) else text if isinstance(text, str) else ""
