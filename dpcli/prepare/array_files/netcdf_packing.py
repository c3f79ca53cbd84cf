"""Numbers that netCDF packed or declares missing by the attributes of their data set, as the CF conventions have it."""

from __future__ import annotations

from typing import Any

import numpy as np

_MISSING = ("_FillValue", "missing_value")  # what stands where no value is
_RANGE = ("valid_range", "valid_min", "valid_max")  # beyond which no value is
_UNSIGNED = "_Unsigned"  # netCDF 3 has no types without sign
PACKING = ("scale_factor", "add_offset", *_MISSING, *_RANGE)  # attributes that `Unpacked` minds


class Unpacked:
    """Shows a data set that netCDF packed (xarray, sensors of weather and satellites) as the numbers that its attributes say it
    stands for, f64, or of its own type where nothing is scaled; NaN where they say that a value is missing. Whole numbers have
    none: they keep what stands there, unless ``gaps`` asks for f64 with NaN where a value is missing.
    """

    def __init__(self, dataset: Any, *, gaps: bool = False) -> None:
        self._dataset, self._gaps, self.attrs = dataset, gaps, dataset.attrs
        self._scale, self._offset = (_number(dataset, name, k) for name, k in (("scale_factor", 1), ("add_offset", 0)))
        self._stored = _stored_type(dataset)
        scaled = (self._scale, self._offset) != (1, 0)
        self.dtype = np.dtype(np.float64) if scaled else self._stored
        self.shape: tuple[int, ...] = dataset.shape
        self.ndim = len(self.shape)

    def __getitem__(self, key: Any) -> np.ndarray:
        stored = self._read(key)
        if self.dtype.kind != "f" and not self._gaps:
            return stored
        missing = self._missing(stored)
        if self.dtype.kind != "f":
            return np.where(missing, np.nan, stored) if missing.any() else stored
        values = stored.astype(np.float64) * self._scale + self._offset
        return np.where(missing, np.nan, values).astype(self.dtype)

    def missing(self) -> np.ndarray:
        """Returns where a value is missing, a mask bool of its shape."""
        return self._missing(self._read(()))

    def with_gaps(self) -> Unpacked:
        """Returns the same numbers with NaN where whole ones are missing, too."""
        return Unpacked(self._dataset, gaps=True)

    def _read(self, key: Any) -> np.ndarray:
        stored = np.asarray(self._dataset[key])
        return stored if stored.dtype == self._stored else stored.view(self._stored)

    def _missing(self, stored: np.ndarray) -> np.ndarray:
        marks = [mark for name in _MISSING for mark in _marks(self._dataset, name, self._stored)]
        least, most = _ends(self._dataset, self._stored)
        wide = stored.astype(np.float64) if stored.dtype.kind == "f" else stored
        beyond = [end for end in (least, most) if end is not None]
        if any(self._is_unpacked(end) for end in beyond):
            wide = wide * self._scale + self._offset
        missing = np.isin(stored, marks) if marks else np.zeros(stored.shape, bool)
        missing |= False if least is None else wide < least
        return missing | (False if most is None else wide > most)

    def _is_unpacked(self, end: np.generic) -> bool:
        """Returns whether the end of a range is one of the numbers meant, by its type, and not of those that are stored."""
        return self.dtype != self._stored and end.dtype.kind == "f" and self._stored.kind in "ui"


def unpacked(dataset: Any) -> Any:
    """Returns a data set of numbers as its attributes mean it: itself where they say nothing."""
    if not {*PACKING, _UNSIGNED} & {*dataset.attrs}:
        return dataset
    packed = (_number(dataset, "scale_factor", 1), _number(dataset, "add_offset", 0)) != (1, 0)
    stored = _stored_type(dataset)
    marked = any(np.isfinite(mark) for name in _MISSING for mark in _marks(dataset, name, stored))
    cut = any(end is not None for end in _ends(dataset, stored))
    return Unpacked(dataset) if packed or marked or cut or stored != dataset.dtype else dataset


def with_gaps(array: Any) -> Any:
    """Returns an array with NaN in place of whole numbers that netCDF declares missing; others as they are."""
    return array.with_gaps() if isinstance(array, Unpacked) else array


def _stored_type(dataset: Any) -> np.dtype:
    """Returns the type of the numbers in a data set, with or without sign, as its attribute says."""
    told = dataset.attrs.get(_UNSIGNED, "")
    text = (told.decode("latin-1") if isinstance(told, bytes) else str(told)).lower()
    kind = {"true": "u", "false": "i"}.get(text, "")
    stored: np.dtype = dataset.dtype
    return np.dtype(stored.byteorder + kind + str(stored.itemsize)) if kind and stored.kind in "ui" else stored


def _marks(dataset: Any, name: str, stored: np.dtype) -> list[np.generic]:
    """Returns the numbers that an attribute tells, those of the data set's own type as that is meant; [] of a text."""
    told = np.ravel(dataset.attrs.get(name, ()))
    if told.dtype.kind not in "uif":
        return []
    turned = told.dtype.kind in "ui" and told.dtype.itemsize == stored.itemsize and stored.kind in "ui"
    return list(told.astype(stored) if turned else told)


def _ends(dataset: Any, stored: np.dtype) -> tuple[np.generic | None, np.generic | None]:
    """Returns the least and the greatest number that a value may be, None where no attribute says it."""
    both = _marks(dataset, "valid_range", stored)
    if len(both) == 2:
        return both[0], both[1]
    ends = [_marks(dataset, name, stored) for name in _RANGE[1:]]
    return tuple(end[0] if len(end) == 1 else None for end in ends)  # type: ignore[return-value]


def _number(dataset: Any, name: str, default: float) -> float:
    """Returns the number that an attribute tells, the default where it tells none."""
    told = np.ravel(dataset.attrs.get(name, default))
    return float(told[0]) if told.dtype.kind in "uif" and told.size == 1 else default
