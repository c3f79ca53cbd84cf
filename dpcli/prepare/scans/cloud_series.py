"""Finds the frames of point cloud sequences in a tree of folders: one sequence at most in each folder."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.parquet import COLUMNAR, is_pose_table
from dpcli.prepare.decode.cloud_files import HDF5, MESHES
from dpcli.prepare.decode.folder_listing import count_suffixes, stores, walk_folders
from dpcli.prepare.reader import natural_key
from dpcli.prepare.series import TEXTS, Series, choose_series, is_beside, is_hidden
from dpcli.prepare.times_beside import with_times

_PREFERRED = (".ply", ".pcd", ".las", ".laz", ".npz", ".npy", ".bin", ".xyz")  # of two files of one frame

_ABOUT_SENSORS = re.compile(  # folders whose texts tell of the vehicle, the camera or the objects
    r"oxts|imu|gps|gnss|poses?|odom\w*|calib\w*|labels?|label_\d|time_?stamps?|traj\w*|(in|ex)trinsics?", re.IGNORECASE
)
_OF_POINTS = re.compile(  # folders whose arrays tell more of the points that lie beside
    r"normals?|colou?rs?|rgb|flows?|feat(ure)?s?|seg\w*|masks?|intensit(y|ies)|reflect\w*|weights?|ids?", re.IGNORECASE
)
_LOOKED_AT = 20, 1000  # lines of a text that may hold poses; of so many points some lie at edges
_FOREIGN = tuple(  # clouds and meshes that others read, and packed ones
    ".obj .stl .off .drc .glb .gltf .fbx .dae .usdz .fls .rcp .rcs .gz .zip .7z .rar .h5 .hdf5 .xlsx .xls .ods"
    " .pcap .pcapng .osf .svo .svo2 .lvx .lvx2 .vtk .vtp .vtu .msh .wrl .x3d .pkl .pt .pth .tfrecord"
    " .ksplat .sog .oni .klg .rrd .vrs .nc .zarr"
    " .usd .usda .usdc .abc .blend .3ds"
    " .jsonl .ndjson .msgpack .avro .orc .rds .rdata .3mf .dxf .pnts .zfs"
    " .c3d .bvh .asf .amc .skeleton .sto .mot"
    " .bag .mcap .db3 .active .bz2 .xz .zst .tar .tgz".split()
)
_MARKERS = ".trc"  # tables of markers, which are read only where that is asked for
_NOTES = (".json", ".yaml", ".yml", ".xml", ".toml")  # that may tell poses, times or labels
_PICTURES = (".png", ".tif", ".tiff", ".pgm", ".pfm", ".exr", ".avi", ".mp4", ".mkv", ".mov")
_WIDE = "give --track columns"
_TABLE = "write a table with a row for each frame and columns such as hip_x, hip_y, hip_z, and give --track columns"
_LINES = "write a table with a row for each point and columns frame, x, y and z"
_ANIMATED = "save their frames as .obj with the same vertices, or export glTF 2.0, which `dpc prepare animation` reads"
_ADVICE = {
    **dict.fromkeys((".gz", ".zip", ".7z", ".rar", ".bz2", ".xz", ".zst", ".tar", ".tgz"), "unpack them"),
    **dict.fromkeys((".bag", ".mcap", ".db3"), "name the recordings themselves"),
    ".active": "end the recording, or repair it by `rosbag reindex` and call it .bag",
    ".nc": "call them .h5 if they are netCDF 4, which is HDF5; else save their arrays as .npy",
    ".zarr": "save their arrays as .npy",
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "save their sheets as .csv"),
    **dict.fromkeys((".ksplat", ".sog"), "save them as .ply, such as with SuperSplat"),
    _MARKERS: "give --track columns",
    ".c3d": "export them as .trc or .csv, and give --track columns",
    **dict.fromkeys((".bvh", ".asf", ".amc"), f"they hold angles of joints: compute where these are, and {_TABLE}"),
    **dict.fromkeys((".sto", ".mot"), f"where their columns are places, call them .txt, and {_WIDE}"),
    **dict.fromkeys((".jsonl", ".ndjson", ".msgpack"), _LINES),
    **dict.fromkeys((".avro", ".orc"), "write them as .parquet"),
    **dict.fromkeys((".rds", ".rdata"), "write their tables as .csv"),
    ".json": f"if they hold joints, {_TABLE}; if points, {_LINES}",
    ".skeleton": f"if they hold joints, {_TABLE}",
    **dict.fromkeys((".abc", ".usd", ".usda", ".usdc", ".usdz", ".blend", ".fbx"), _ANIMATED),
    **dict.fromkeys(
        (".glb", ".gltf"), "where one is animated, `dpc prepare animation` reads it; else save their points as .ply"
    ),
    **dict.fromkeys((".oni", ".klg"), "write their depth as 16-bit PNG, which `dpc prepare depth` reads"),
}


def find_sequences(
    root: Path, suffixes: Sequence[str], *, pattern: str = "", table: Path | None = None
) -> list[Series]:
    """Returns the sequence of every folder at or below ``root`` that holds one, in natural order of the folders.

    suffixes: of point clouds. pattern: of the names of frames. table: a file that is no cloud, whatever its name. Raises
    DataError when there is none, or when a folder's clip must be chosen.
    """
    found, poses, foreigners, alone = [], [], Counter[str](), []
    for folder, names, foreign in _folders(root, suffixes, table.resolve() if table else None):
        foreigners += foreign
        series = choose_series(folder, names, pattern=pattern, suffixes=_PREFERRED) if names else None
        if series:
            series = replace(series, left_out=(*series.left_out, *_counted(foreign)))
            (poses if is_pose(series.paths[0]) else found).append(series)
        else:
            where = "" if folder == root else f"{folder.relative_to(root).as_posix()}/"
            alone += [f"{where}{one}" for one in (*sorted(filter(is_beside, names)), *_counted(foreign))]
    if not found:
        others = Counter({suffix: count for suffix, count in foreigners.items() if suffix not in _NOTES})
        others = others or Counter({suffix: count for suffix, count in foreigners.items() if suffix in _ADVICE})
        for last in (MESHES, HDF5):
            if any(others[suffix] for suffix in last) and tuple(suffixes) not in (MESHES, HDF5):
                return find_sequences(root, last, pattern=pattern, table=table)
        asked = f" whose names fit --pattern '{pattern}'" if pattern else ""
        advice = f"; found {', '.join(_counted(others))}: {_advice(others)}" if others else _of_pictures(root)
        raise DataError(f"{root}: no point clouds ({', '.join(suffixes)}){asked}, or folders of them{advice}")
    ordered = sorted(found, key=lambda one: natural_key(one.folder.relative_to(root).as_posix()))
    first, *rest = [with_times(one, root) for one in _without_logs(root, ordered, poses, alone)]
    used = {one.beside.path.relative_to(root).as_posix() for one in (first, *rest) if one.beside}
    return [replace(first, left_out=tuple(name for name in first.left_out if name not in used)), *rest]


def _of_pictures(root: Path) -> str:
    """Returns what to do with the pictures or videos below a folder without clouds, "" where there are none."""
    found = count_suffixes((name for _, _, files in walk_folders(root) for name in files), _PICTURES)
    return f"; found {', '.join(_counted(found))}: if they hold depth, `dpc prepare depth` reads them" if found else ""


def _without_logs(root: Path, found: list[Series], poses: list[Series], alone: list[str]) -> list[Series]:
    """Returns the sequences without the texts of folders such as KITTI's ``oxts``, one text above the folders of clouds, and
    arrays of normals, colors and the like; all of them where there is nothing else.

    The first one names those as left out, the poses that were found, and ``alone``: what lies in folders without clouds.
    """
    scans = [one for one in found if one.suffix not in TEXTS]
    above_scans = {folder for one in scans for folder in one.folder.parents}
    neighbors: dict[Path, list[Series]] = {}
    for one in scans:
        neighbors.setdefault(one.folder.parent, []).append(one)

    def is_log(one: Series) -> bool:
        if one.suffix not in TEXTS:
            if one.folder == root or not _OF_POINTS.fullmatch(one.folder.name):
                return False
            twins = [other for other in neighbors[one.folder.parent] if other is not one]
            return any(one.stems == other.stems for other in twins)
        above = len(one.names) == 1 and one.folder in above_scans
        return above or any(_ABOUT_SENSORS.fullmatch(part) for part in one.folder.relative_to(root).parts)

    logs = {one: None for one in found if is_log(one)}
    logs = {} if len(logs) == len(found) else logs
    first, *others = [one for one in found if one not in logs]
    named = sorted(
        (one.folder / name).relative_to(root).as_posix()
        for one in (*poses, *logs)
        for name in (one.described(), *one.left_out)
    )
    return [replace(first, left_out=(*first.left_out, *named, *alone)), *others]


def refuse_file(path: Path, suffixes: Sequence[str]) -> None:
    """Raises DataError where a path is one file or store, a cloud or of a format that is not read, and says what to do with it."""
    suffix = path.suffix.lower()
    whole = path.is_file() or (path.is_dir() and stores([path.name]))
    if suffix in (*_FOREIGN, ".json") and suffix not in (_MARKERS, *MESHES) and whole:
        advice = _advice([suffix])
        end = "" if "--track" in advice else ", and name their folder or table"
        raise DataError(f"{path}: {suffix} files are not read: {advice}{end}")
    if is_cloud(path.name, (*suffixes, *MESHES)) and path.is_file():
        raise DataError(f"{path}: one cloud; expected a folder, whose files are the frames of a sequence")


def _advice(suffixes: Iterable[str]) -> str:
    told = dict.fromkeys(_ADVICE.get(suffix, "save their points as .ply") for suffix in suffixes)
    return ", or ".join(told)


def _counted(foreign: Counter[str]) -> tuple[str, ...]:
    return tuple(counted(count, f"{suffix} file") for suffix, count in sorted(foreign.items()))


def left_out_below(root: Path, read: tuple[str, ...]) -> list[str]:
    """Returns a line for the log that counts the files of formats that aren't read below a folder, none where there are none.

    read: suffixes of those formats that are read after all.
    """
    foreign = tuple(one for one in _FOREIGN if one not in read)
    found = count_suffixes((name for _, _, files in walk_folders(root) for name in files), foreign)
    return [f"left out: {', '.join(_counted(found))} ({_advice(found)})"] if found else []


def _folders(root: Path, suffixes: Sequence[str], table: Path | None) -> Iterator[tuple[Path, list[str], Counter[str]]]:
    """Yields every folder at or below ``root`` with the names of its point clouds, and how many it has in formats that
    are not read, by suffix; no folder that has neither.
    """
    for folder, below, names in walk_folders(root):
        clouds = [name for name in names if is_cloud(name, suffixes) and Path(folder, name).is_file()]
        if table is not None:
            clouds = [name for name in clouds if Path(folder, name).resolve() != table]
        foreign = count_suffixes(
            [*names, *stores(below)], tuple(one for one in (*_FOREIGN, _MARKERS, *_NOTES) if one not in suffixes)
        )
        if clouds or foreign:
            yield Path(folder), clouds, foreign


def is_cloud(name: str, suffixes: Sequence[str]) -> bool:
    """Returns whether a file name looks like a point cloud."""
    return name.lower().endswith(tuple(suffixes)) and not is_hidden(name)


def is_pose(path: Path) -> bool:
    """Returns whether a text or table holds the pose of a camera, or those of its way: no cloud.

    In a text that is a 4x4 or 3x4 matrix that turns, one in each row, or rows that end with a quaternion, as KITTI and TUM have
    them; in a table (Parquet, Feather) the names tell.
    """
    if path.suffix.lower() in COLUMNAR:
        return is_pose_table(path)
    return path.suffix.lower() in TEXTS and all(_begins_with_poses(path, count) for count in _LOOKED_AT)


def _begins_with_poses(path: Path, count: int) -> bool:
    """Returns whether the first lines of a text hold poses and nothing else."""
    try:
        with path.open() as file:
            lines = [line for line in islice(file, count) if line.strip() and not line.startswith("#")]
        rows = [[float(v) for v in line.replace(",", " ").split()] for line in lines]
    except ValueError:  # words, or no text at all
        return False
    widths = {len(row) for row in rows}
    if widths == {4} and len(rows) in (3, 4):
        rows = [[value for row in rows for value in row]]
    elif len(widths) != 1 or not widths <= {7, 8, 12, 16} or (len(rows) < 3 and widths <= {7, 8}):
        return False
    values = np.array(rows)
    if values.shape[1] < 12:
        return _are_quaternions(values[:, -4:])
    turns = values[:, :12].reshape(-1, 3, 4)[:, :, :3]
    return bool(np.allclose(turns @ turns.transpose(0, 2, 1), np.eye(3), atol=1e-3))


def _are_quaternions(values: np.ndarray) -> bool:
    """Returns whether numbers (N,4) turn, not all alike; no normals of points with an intensity or a curvature of 0 beside."""
    varying = np.ptp(values, axis=0) > 0
    normals = varying.sum() == 3 and not values[:, ~varying].any() and not varying[[0, 3]].all()
    return bool(np.allclose((values**2).sum(1), 1, atol=1e-3) and varying.any() and not normals)
