"""Damage to HDF5 files through the library: data sets, attributes, links and shapes that a whole file can still have."""

from __future__ import annotations

import os
import random
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tests.fuzz.mutators import NAMES, VALUES, text

_MOST = 1 << 20  # bytes that are read and written again: this process lives as long as all of its inputs
_TYPES = ("f4", "f8", "i8", "u1", "S4", "c8", "f2", ">i4", "u8", "b1")


def hdf5(data: bytes, rng: random.Random) -> bytes:
    """The file with one object or attribute changed."""
    number, name = tempfile.mkstemp(suffix=".h5")
    try:
        os.write(number, data)
        os.close(number)
        with h5py.File(name, "r+") as file:
            _change(file, rng)
        return Path(name).read_bytes()
    finally:
        os.unlink(name)


def _change(file: h5py.File, rng: random.Random) -> None:
    names: list[str] = []
    file.visit(names.append)
    name = rng.choice(names)
    holders = [one for one in ("/", *names) if len(file[one].attrs)]
    if holders and rng.random() < 0.35:
        _change_attribute(file[rng.choice(holders)].attrs, rng)
    elif isinstance(file[name], h5py.Dataset) and file[name].nbytes > _MOST:  # a damage before made it huge
        _removed(file, name, rng)
    elif isinstance(file[name], h5py.Dataset) and rng.random() < 0.8:
        rng.choice((_other_values, _other_values, _other_type, _other_shape, _huge, _text_values))(file, name, rng)
    else:
        rng.choice((_replaced, _linked, _removed))(file, name, rng)


def _change_attribute(attributes: h5py.AttributeManager, rng: random.Random) -> None:
    name = rng.choice(sorted(attributes))
    old = attributes[name]
    if rng.random() < 0.15:
        del attributes[name]
    elif isinstance(old, str) and rng.random() < 0.6:
        attributes[name] = text((old or "x").encode(), rng).decode(errors="replace").replace("\0", "")
    else:
        attributes[name] = _attribute(rng)


def _attribute(rng: random.Random) -> Any:
    kinds = [one for one in VALUES if isinstance(one, (int, float)) and abs(one) < 2**63]
    plain = rng.choice(
        (*kinds, *(one.split("\0")[0] for one in NAMES if "\ud800" not in one), np.zeros(0), b"\xff\xfe")
    )
    return rng.choice((plain, np.zeros((3, 3)), np.array(["a", "b"], "S1"), h5py.Empty("f4"), [plain]))


def _rewritten(file: h5py.File, name: str, values: Any, **options: Any) -> None:
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, data=values, **options)
    file[name].attrs.update(attributes)


def _other_values(file: h5py.File, name: str, rng: random.Random) -> None:
    values = np.array(file[name][()])
    if values.dtype.kind not in "fiu" or values.size == 0:
        return _replaced(file, name, rng)
    kind = values.dtype
    odd = (np.nan, np.inf, 1e38, -1, 0) if kind.kind == "f" else (0, -1, np.iinfo(kind).max, np.iinfo(kind).min, 7)
    with np.errstate(all="ignore"):
        start = rng.randrange(values.size)
        values.reshape(-1)[start : start + rng.choice((1, 1, values.size))] = np.array(rng.choice(odd)).astype(kind)
    if rng.random() < 0.2:
        values = values[::-1]
    file[name][...] = values


def _other_type(file: h5py.File, name: str, rng: random.Random) -> None:
    values = np.array(file[name][()])
    if values.dtype.kind == "O":
        return _replaced(file, name, rng)
    with np.errstate(all="ignore"):
        _rewritten(file, name, values.astype(rng.choice(_TYPES)))


def _other_shape(file: h5py.File, name: str, rng: random.Random) -> None:
    values = np.array(file[name][()])
    cut = values[: max(len(values) - 1, 0)] if values.ndim else values
    _rewritten(
        file, name, rng.choice((cut, values[None], values.reshape(-1), np.concatenate([values.reshape(-1)] * 2)))
    )


def _huge(file: h5py.File, name: str, rng: random.Random) -> None:
    """A shape that no file can hold; its chunks were never written."""
    kind, shape = file[name].dtype, list(file[name].shape or (1,))
    del file[name]
    shape[rng.randrange(len(shape))] = rng.choice((10**7, 2**32, 2**40))
    file.create_dataset(name, shape=tuple(shape), dtype=kind, chunks=tuple(min(n, 8) or 1 for n in shape))


def _text_values(file: h5py.File, name: str, rng: random.Random) -> None:
    values = np.array(file[name][()])
    if values.dtype.kind not in "OS" or values.size == 0:
        return _other_values(file, name, rng)
    flat = values.reshape(-1).astype(object)
    odd = rng.choice(NAMES).split("\0")[0].encode("utf-8", "surrogatepass")
    flat[rng.randrange(flat.size)] = odd if rng.random() < 0.7 else flat[0]
    _rewritten(file, name, flat.reshape(values.shape), dtype=h5py.string_dtype())


def _replaced(file: h5py.File, name: str, rng: random.Random) -> None:
    del file[name]
    if rng.random() < 0.3:
        file.create_group(name)
    else:
        file[name] = rng.choice((np.zeros(0), 3.5, "text", np.zeros((2, 2, 2)), h5py.Empty("f4"), np.arange(5)))


def _linked(file: h5py.File, name: str, rng: random.Random) -> None:
    del file[name]
    file[name] = rng.choice(
        (h5py.SoftLink("/nowhere"), h5py.SoftLink(f"/{name}"), h5py.ExternalLink("../../outside/x", "/"))
    )


def _removed(file: h5py.File, name: str, _rng: random.Random) -> None:
    del file[name]
