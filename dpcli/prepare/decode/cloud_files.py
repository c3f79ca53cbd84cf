"""Reading one point cloud from a file of any common format."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.arrays import guess_bin_columns, read_bin, read_mat, read_npy, read_npz
from dpcli.prepare.cloud_formats.cloud import Cloud
from dpcli.prepare.cloud_formats.gaussians import read_splat, read_spz
from dpcli.prepare.cloud_formats.las import read_las
from dpcli.prepare.cloud_formats.parquet import read_parquet
from dpcli.prepare.cloud_formats.pcd import read_pcd
from dpcli.prepare.cloud_formats.ply import read_ply
from dpcli.prepare.cloud_formats.ptx import read_ptx
from dpcli.prepare.cloud_formats.text_cloud import read_text, read_vertices
from dpcli.prepare.decode.e57_files import read_e57
from dpcli.runtime.clips.other_files import stand_ins_named

_CLOUDS: dict[str, Callable[[Path, Sequence[str]], Cloud]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".las": read_las,
    ".laz": read_las,
    ".npy": read_npy,
    ".npz": read_npz,
    ".parquet": read_parquet,
    ".feather": read_parquet,
    ".arrow": read_parquet,
    ".ptx": read_ptx,
    ".csv": read_text,
    ".tsv": read_text,
    ".xyz": read_text,
    ".pts": read_text,
    ".asc": read_text,
    ".txt": read_text,
    ".xyzn": read_text,
    ".xyzrgb": read_text,
    ".xyzi": read_text,
    ".splat": read_splat,
    ".spz": read_spz,
    ".mat": read_mat,
    ".e57": read_e57,
}
MESHES = (".obj", ".off")  # whose vertices are read where there is nothing else
HDF5 = (".h5", ".hdf5")  # which are read where there is nothing else: what dpc makes may lie beside the clouds
SUFFIXES = (".ply", ".pcd", ".las", ".laz", ".bin", *list(_CLOUDS)[4:])
_READERS = {**_CLOUDS, **dict.fromkeys(MESHES, read_vertices), **dict.fromkeys(HDF5, read_mat)}


def read_cloud(path: Path, bin_columns: int | None = None, keep: Sequence[str] = ()) -> Cloud:
    """Reads one cloud. Raises DataError, which says what is wrong.

    ``bin_columns``: float32 values per point of a ``.bin``, None to judge by the values. ``keep``: names of further
    columns.
    """
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the file is empty")
    suffix = path.suffix.lower()
    with stand_ins_named(path):
        if suffix != ".bin":
            return _READERS[suffix](path, keep)
        if keep:
            raise DataError(f"{path}: column {keep[0]}: the columns of a .bin have no names")
        return read_bin(path, bin_columns or guess_bin_columns([path])[0])
