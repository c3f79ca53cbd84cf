"""Files that hold named arrays: NumPy's, HDF5's and MATLAB's, opened so that what isn't asked for isn't read."""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from dpcli.errors import DataError, reading
from dpcli.file_cache import cached_by_file
from dpcli.npy_files import map_npy, open_archive, read_header, read_member, require_room
from dpcli.prepare.array_files.attributes import says_text, texts_about
from dpcli.prepare.array_files.mat5 import joined, read_variables
from dpcli.prepare.array_files.netcdf_packing import unpacked
from dpcli.prepare.array_files.safe_pickle import load_arrays

if TYPE_CHECKING:
    import h5py

SUFFIXES = (".npy", ".npz", ".h5", ".hdf5", ".mat")
_HDF5 = b"\x89HDF\r\n\x1a\n"
_MOST = 10_000  # data sets of a file that are looked at
_FEW = 1 << 20  # elements of a list of arrays
_ROWS_OF_CAMERA = 4  # of the largest arrays that tell of a camera, and of no points
_OBJECT = "MATLAB_object_decode"  # the attribute of what MATLAB keeps elsewhere in the file: tables, dates, texts
_OCTAVE = "OCTAVE_NEW_FORMAT"  # the attribute of what Octave's save -hdf5 writes
Content = TypeVar("Content")
_BARE_DIMENSION = "This is a netCDF dimension but not a netCDF variable"


class _NoNumbersError(DataError):
    """Tells that an array of objects holds other things than arrays of numbers."""


class ByName(dict[str, Content]):
    """Holds something for each array of a file by name, and what was found out about them: by the pattern that they fit, the names
    of each group, the lists that cells of MATLAB are, and texts that tell units (`attributes.told_lengths`). A file may hold
    thousands of sequences, and its names are searched and its cells read once, not for each of them.
    """

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.fitting: dict[re.Pattern[str], dict[str, list[str]]] = {}
        self.cells: dict[str, np.ndarray | list[np.ndarray]] = {}
        self.texts: dict[str, str] = {}


class Reversed:
    """Shows a data set that MATLAB wrote with its axes in MATLAB's order; HDF5 has them the other way round."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self.shape: tuple[int, ...] = dataset.shape[::-1]
        self.dtype: np.dtype = dataset.dtype
        self.ndim = len(self.shape)

    def __getitem__(self, key: Any) -> np.ndarray:
        places = key if isinstance(key, tuple) else (key,)
        full = (*places, *[slice(None)] * (self.ndim - len(places)))
        return np.asarray(self._dataset[full[::-1]]).T


class Unreadable:
    """Shows a data set that can't be read, so that an error says why only where somebody asks for its numbers: a file may hold
    others that nobody needs, such as the indices of PyTables, most of which were never written.
    """

    def __init__(self, dataset: Any, error: DataError) -> None:
        self.attrs, self._error = dataset.attrs, error
        self.shape: tuple[int, ...] = dataset.shape
        self.dtype: np.dtype = dataset.dtype
        self.ndim = len(self.shape)

    def __getitem__(self, key: Any) -> np.ndarray:
        raise self._error


Array = Any  # np.ndarray, h5py.Dataset, Reversed, Unpacked or Unreadable: shape, dtype, ndim, and slices of it by []


@contextmanager
def open_arrays(path: Path) -> Iterator[Mapping[str, Array | list[np.ndarray]]]:
    """Opens the arrays of numbers in a file by name ("" in a ``.npy``), each with ``shape``, ``dtype`` and slices, which alone
    are read where the format allows it. A list, of an object array or a MATLAB cell, holds arrays of their own shapes.

    Raises DataError when the file is damaged, a pickle of more than arrays, or one that dpc made.
    """
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the file is empty")
    if is_hdf5(path):
        with reading(path), _open_hdf5(path) as found:
            yield found
        return
    yield _read_all(path)


def is_hdf5(path: Path) -> bool:
    """Returns whether a file is HDF5, as MATLAB 7.3 writes it too: by its first bytes, whatever its name."""
    with path.open("rb") as file:
        head = file.read(520)
    return head.startswith(_HDF5) or head[512:520] == _HDF5


def made_by_dpc(path: Path) -> bool:
    """Returns whether a file is one of the contract, such as the output of an earlier conversion beside the raw data."""
    import h5py

    if path.suffix.lower() not in (".h5", ".hdf5") or not path.is_file() or not is_hdf5(path):
        return False
    try:
        with h5py.File(path, "r") as file:
            return "dpc_kind" in file.attrs
    except OSError:
        return False


def tables_inside(path: Path) -> list[str]:
    """Returns the names of the tables in a file, whose columns are called by name, "" of a file's only array: PyTables and
    pandas keep them so in HDF5, NumPy as structured arrays.
    """
    import h5py

    if not is_hdf5(path):
        arrays = {} if path.suffix.lower() == ".mat" else _read_all(path)
        return [name for name, one in arrays.items() if not isinstance(one, list) and one.dtype.names]
    found: list[str] = []

    def note(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            _require_type(item, path)
            is_table = item.dtype.names
        else:
            is_table = isinstance(item, h5py.Group) and "pandas_type" in item.attrs
        if is_table:
            found.append(name)

    with reading(path), h5py.File(path, "r") as file:
        file.visititems(note)
    return [name for name in found if not any(name.startswith(f"{other}/") for other in found)]


def read_tables(path: Path) -> dict[str, tuple[dict[str, np.ndarray], dict[str, Any]]]:
    """Returns the tables of `tables_inside` by name: their columns (N, or N and several) as stored, and their attributes."""
    names = tables_inside(path)
    if not names or not is_hdf5(path):
        arrays = _read_all(path) if names else {}
        flat = {name: np.asarray(arrays[name]).reshape(-1) for name in names}
        return {name: ({own: one[own] for own in one.dtype.names or ()}, {}) for name, one in flat.items()}
    with reading(path), _hdf5_of_others(path) as file:
        return {name: _table_of(file[name], path) for name in names}


def _table_of(item: Any, path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns columns and attributes of a data set of a compound type, or of a group of pandas, whose kinds are ``table`` and
    ``fixed``.
    """
    import h5py

    if isinstance(item, h5py.Dataset) or "table" in item:
        rows = item if isinstance(item, h5py.Dataset) else _own(item, "table", path)
        values = _checked(rows, path)[()].reshape(-1)
        return {name: values[name] for name in values.dtype.names}, dict(rows.attrs)
    found, about = {}, {}
    for place in range(len(item)):
        if f"block{place}_items" in item:
            called = own_data_set(item, f"block{place}_items", path)[()].tolist()
            names = [str(one, "utf-8", "replace") for one in called]
            values = own_data_set(item, f"block{place}_values", path)[()]
            if values.ndim == 2 and values.shape[1] == len(names):  # texts are a pickle
                found |= dict(zip(names, values.T))
                about |= {f"{name}_dtype": item[f"block{place}_values"].attrs.get("value_type", "") for name in names}
    index = _own(item, "axis1", path) if "axis1" in item else None
    if index is not None and index.dtype.kind in "uif" and found:
        name = str(np.asarray(index.attrs.get("name", b"N.")).astype(str))
        found = {"index" if name == "N." else name: _checked(index, path)[()], **found}  # a pickle of None
    return found, about


def own_data_set(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    """Returns a data set by name. Raises DataError where it is absent or a link, and as `_checked` does."""
    return _checked(_own(group, name, path), path)


def _own(group: h5py.Group, name: str, path: Path) -> h5py.Dataset:
    import h5py

    is_link = not isinstance(group.get(name, getlink=True), h5py.HardLink)  # perhaps to another file
    if is_link or not isinstance(group[name], h5py.Dataset):
        raise DataError(f"{path}: no data set {name!r} of its own; found {', '.join(sorted(group)) or 'none'}")
    return group[name]


def _checked(item: h5py.Dataset, path: Path) -> h5py.Dataset:
    """Returns a data set. Raises DataError where its bytes are missing, elsewhere, or packed by a filter that is missing."""
    _refuse_elsewhere(item, path, item.name)
    _require_bytes(item, path)
    return item


def others_inside(path: Path, arrays: Mapping[str, Any]) -> list[str]:
    """Returns the names of what an HDF5 or NumPy's archive holds beside its ``arrays``: texts, dates, single numbers."""
    import h5py

    names: list[str] = []
    if is_hdf5(path):
        with reading(path), h5py.File(path, "r") as file:
            kinds = {name: item for name, item in _datasets(file, path) if not _is_bare_dimension(item)}
            names = [name if _OBJECT not in item.attrs else _of_object(name, item) for name, item in kinds.items()]
            links: list[tuple[str, Any]] = []
            file.visititems_links(lambda name, link: links.append((name, link)))
            names += [f"{name} (in {link.filename})" for name, link in links if isinstance(link, h5py.ExternalLink)]
    elif path.suffix.lower() == ".npz":
        with reading(path), open_archive(path) as archive:
            names = [name.removesuffix(".npy") for name in archive.namelist()]
    return [name for name in names if name not in arrays]


def _of_object(name: str, item: h5py.Dataset) -> str:
    kind = np.bytes_(item.attrs.get("MATLAB_class", b"object")).decode("latin-1")
    return f"{name} (a {kind} of MATLAB; save its columns as arrays of numbers)"


@contextmanager
def _hdf5_of_others(path: Path) -> Iterator[h5py.File]:
    import h5py

    from dpcli.store.heap_check import check_heaps

    check_heaps(path)
    with h5py.File(path, "r") as file:
        if "dpc_kind" in file.attrs:
            raise DataError(
                f"{path}: dpc made it; `dpc info {path}` says what it holds, and what comes next reads it as it is"
            )
        yield file


@contextmanager
def _open_hdf5(path: Path) -> Iterator[Mapping[str, Array | list[np.ndarray]]]:
    names = _names_in(path)
    with _hdf5_of_others(path) as file:
        yield _Opened(names, lambda name: _shown(file, file[names[name]], path), dict(names.cells))


@cached_by_file(1)
def _names_in(path: Path) -> ByName[str]:
    """Returns the arrays in an HDF5 file by name, and where in it they lie."""
    with _hdf5_of_others(path) as file:
        items = dict(_datasets(file, path))
        shown = {name: _shown(file, item, path) for name, item in items.items()}
        found = {name: array for name, array in shown.items() if array is not None}
        names = ByName({name: items[name].name for name in found})
        names.cells = {name: array for name, array in found.items() if isinstance(array, (list, np.ndarray))}
        names.texts = texts_about(items)
        return names


class _Opened(Mapping[str, Any]):
    """Opens the arrays of a file whose names are known as they are asked for: sequences are read one by one from files with
    thousands of arrays.
    """

    def __init__(self, names: ByName[str], show: Callable[[str], Any], found: dict[str, Any]) -> None:
        self._names, self._show, self._found = names, show, found
        self.fitting, self.texts = names.fitting, names.texts

    def __getitem__(self, name: str) -> Any:
        if name not in self._found:
            if name not in self._names:
                raise KeyError(name)
            self._found[name] = self._show(name)
        return self._found[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _shown(file: h5py.File, item: h5py.Dataset, path: Path) -> Array | list[np.ndarray] | None:
    """Returns a data set as its numbers are meant, the list of a MATLAB cell; None of anything else."""
    import h5py

    if item.dtype == h5py.ref_dtype and item.ndim == 2 and 0 < item.size < _FEW:
        return _cells(file, item, path)
    if item.dtype.kind not in "uifb" or item.shape is None or _is_bare_dimension(item) or _is_no_array(item):
        return None
    try:
        _require_bytes(item, path)
    except DataError as error:
        return Unreadable(item, error)
    if path.suffix.lower() == ".mat":
        return Reversed(item)
    return unpacked(item)


def _require_type(item: h5py.Dataset, path: Path) -> None:
    """Raises DataError for a data set of a type that h5py has no numbers for, such as PyTables' times."""
    try:
        _ = item.dtype
    except TypeError as error:
        raise DataError(
            f"{path}: {item.name} is of a type that isn't read ({error}); write it without, such as times as Float64Col"
        ) from None


def _is_no_array(item: h5py.Dataset) -> bool:
    """Returns whether the numbers of a data set are the letters of one of MATLAB's texts, or places of the contents of an object,
    such as a table.
    """
    return item.attrs.get("MATLAB_class") == b"char" or _OBJECT in item.attrs


def _is_bare_dimension(item: h5py.Dataset) -> bool:
    """Returns whether a data set is only the name and length of a dimension of netCDF, without values."""
    return _BARE_DIMENSION in str(item.attrs.get("NAME", ""))


def _refuse_elsewhere(item: h5py.Dataset, path: Path, name: str) -> None:
    if item.is_virtual or item.external:
        raise DataError(f"{path}: {name} keeps its data in another file; copy them into one (h5repack)")


def _require_bytes(item: h5py.Dataset, path: Path) -> None:
    """Raises DataError for a data set whose bytes are missing, or packed by a filter that the HDF5 library here lacks, such as
    Blosc.
    """
    import h5py

    from dpcli.store.file import refuse_claim

    refuse_claim(item, path)
    plist = item.id.get_create_plist()
    for place in range(plist.get_nfilters()):
        code, _, _, name = plist.get_filter(place)
        if not h5py.h5z.filter_avail(code):
            raise DataError(
                f"{path}: {item.name} was packed by {name.decode('latin-1') or 'a filter'} (HDF5 filter {code}), which is missing"
                " here; write it again with gzip, or unpacked"
            )


def _datasets(file: h5py.File, path: Path) -> list[tuple[str, h5py.Dataset]]:
    """Returns the data sets in a file by name, each once, those of Octave by the names of its variables; links to other files
    are not followed.
    """
    import h5py

    found: list[tuple[str, h5py.Dataset]] = []
    own = [name for name in file if isinstance(file.get(name, getlink=True), h5py.HardLink)]
    of_octave = {name for name in own if _OCTAVE in file[name].attrs}

    def note(name: str, item: Any) -> None:
        if len(found) > _MOST:
            raise DataError(f"{path}: holds more than {_MOST} data sets; join those of one sequence")
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):  # #refs#, the contents of MATLAB's cells
            _require_type(item, path)
            _refuse_elsewhere(item, path, name)
            own = _name_in_octave(name) if name.split("/")[0] in of_octave else name
            found.extend([(own, item)] if own else [])

    file.visititems(note)
    return found


def _name_in_octave(name: str) -> str:
    """Returns what Octave calls the data set of a variable, a field or a cell; "" of those that tell its type or size.

    >>> _name_in_octave("s/value/points/value"), _name_in_octave("points/value/_01/value"), _name_in_octave("s/type")
    ('s/points', 'points/_01', '')
    """
    parts = name.split("/")
    return "/".join(parts[::2]) if len(parts) % 2 == 0 and set(parts[1::2]) == {"value"} else ""


def _cells(file: h5py.File, item: h5py.Dataset, path: Path) -> np.ndarray | list[np.ndarray] | None:
    """Returns the arrays of a MATLAB cell, or of one field of several structs, column after column; None where these hold
    something else.
    """
    import h5py

    of_structs = "MATLAB_class" not in item.attrs and item.parent.attrs.get("MATLAB_class") == b"struct"
    if item.attrs.get("MATLAB_class") != b"cell" and not of_structs:
        return None
    _require_bytes(item, path)
    inside = [file[reference] for reference in item[()].reshape(-1)]
    if not all(isinstance(one, h5py.Dataset) and one.dtype.kind in "uif" and not _is_no_array(one) for one in inside):
        return None
    return joined([np.zeros((0, 0)) if one.attrs.get("MATLAB_empty") else _checked(one, path)[()].T for one in inside])


@cached_by_file(1)  # an array holds many sequences; each process reads it once
def _read_all(path: Path) -> Mapping[str, Array | list[np.ndarray]]:
    """Returns the arrays of a file that is no HDF5."""
    if path.suffix.lower() == ".npy":
        return {"": _npy(path)}
    if path.suffix.lower() == ".mat":
        return _apart(read_variables(path))
    if path.suffix.lower() in (".h5", ".hdf5"):
        raise DataError(f"{path}: not a readable HDF5 file, perhaps truncated")
    with reading(path), open_archive(path) as archive:
        require_room(path, sum(info.file_size for info in archive.infolist()))
        members = [info for info in archive.infolist() if info.filename.endswith(".npy")]
        arrays, foreign = {}, None
        for one in members:
            try:
                array = _member(path, archive.read(one))
            # pictures, names or settings beside the clouds, or the clouds in another form
            except _NoNumbersError as error:
                foreign = foreign or error
                continue
            name = one.filename[: -len(".npy")]
            told = not isinstance(array, list) and array.dtype.kind == "U" and array.size == 1 and says_text(name)
            if isinstance(array, list) or array.dtype.kind in "uifbM" or array.dtype.names or told:
                arrays[name] = array
    if foreign and not any(isinstance(one, list) or one.ndim and len(one) > _ROWS_OF_CAMERA for one in arrays.values()):
        raise foreign
    return _apart(arrays)


def _apart(found: dict[str, np.ndarray | list[np.ndarray]]) -> ByName[np.ndarray | list[np.ndarray]]:
    """Returns arrays with the texts among them, which tell units and models of lenses, apart."""
    texts = {name: one.item() for name, one in found.items() if not isinstance(one, list) and one.dtype.kind == "U"}
    arrays = ByName({name: one for name, one in found.items() if name not in texts})
    arrays.texts = texts
    return arrays


def _npy(path: Path) -> np.ndarray | list[np.ndarray]:
    try:
        return map_npy(path)
    except DataError:
        with path.open("rb") as file:
            if not _needs_pickle(file):
                raise
    require_room(path, path.stat().st_size)
    return _member(path, path.read_bytes())


def _needs_pickle(file: Any) -> bool:
    try:
        return bool(read_header(file)[2].hasobject)
    except Exception:  # a damaged header raises nearly anything; reading says so
        return False


def _member(path: Path, data: bytes) -> np.ndarray | list[np.ndarray]:
    """Returns an array, or the arrays of an object array, which is a pickle that may hold nothing else."""
    stream = io.BytesIO(data)
    if not _needs_pickle(stream):
        return read_member(path, data)
    try:
        objects = load_arrays(stream)
    except pickle.UnpicklingError as error:
        raise _NoNumbersError(f"{path}: a pickle that is not of plain arrays: {error}; it was not loaded") from None
    except Exception as error:  # a damaged pickle stream raises nearly anything
        raise DataError(f"{path}: cannot be read ({type(error).__name__}: {error}); copy it again") from None
    objects = objects.item() if isinstance(objects, np.ndarray) and objects.shape == () else objects
    if isinstance(objects, np.ndarray) and objects.ndim > 1:
        try:  # equal frames in one object array lose their type, not their numbers
            return objects.astype(np.float64)
        except (TypeError, ValueError):
            pass
    parts = list(objects) if isinstance(objects, (np.ndarray, list, tuple)) else [objects]
    if not all(isinstance(one, np.ndarray) and one.dtype.kind in "uif" for one in parts):
        raise _NoNumbersError(f"{path}: a pickle of other things than arrays of numbers; save the clouds as arrays")
    return [np.array(one, one.dtype) for one in parts]  # plain arrays, whatever the pickle's
