"""Summarizes a file of the contract, as data: kind, counts, lengths, classes, ranges, provenance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dpcli.errors import reading
from dpcli.store.clouds_reader import CloudsReader
from dpcli.store.embedding import EmbeddingReader
from dpcli.store.file import open_store, read_provenance, root_attributes
from dpcli.store.gaussians import read_scene
from dpcli.store.parts import PartsReader
from dpcli.store.scores import ScoresReader
from dpcli.store.statistics import StatisticsReader
from dpcli.store.views import ViewsReader

_ROWS = 1 << 20  # points read at a time for the ranges: 12 MiB
_WIDE = 1024  # points side by side in one row while reducing
_SPLITS = ("train", "validation", "val", "test")  # the order people expect


def summary(path: str | Path) -> dict[str, Any]:
    """Returns everything `dpc info` tells, as plain values for JSON. Raises DataError as the readers do."""
    path = Path(path)
    with open_store(path) as file:
        root = root_attributes(file)
        kind = str(root["dpc_kind"])
        common = {
            "kind": kind,
            "bytes": path.stat().st_size,
            **{key: root.get(f"dpc_{key}") for key in ("schema", "version")},
            **{key: root.get(key) for key in ("source", "seed", "length_unit")},
            "provenance": read_provenance(file),
            "datasets": _datasets(file),
        }
    own = {
        "clouds": _clouds,
        "parts": _parts,
        "scores": _scores,
        "views": _views,
        "gaussians": _gaussians,
        "embedding": _embedding,
        "statistics": _statistics,
    }[kind]
    with reading(path):
        return {**common, **own(path)}


def _datasets(file: h5py.File) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            kind = "str" if h5py.check_string_dtype(item.dtype) else str(item.dtype)
            found.append({"name": name, "shape": list(item.shape), "type": kind, "compression": item.compression})

    file.visititems(visit)
    return found


def _clouds(path: Path) -> dict[str, Any]:
    with CloudsReader(path) as reader:
        ranges, not_finite = point_ranges(reader)
        return {
            "counts": {
                "sequences": len(reader),
                "frames": int(reader.frame_counts.sum()),
                "points": reader.num_points,
                "empty_frames": int((reader.frame_sizes == 0).sum()),
                "not_finite_points": not_finite,
            },
            "frames_per_sequence": _spread(reader.frame_counts),
            "points_per_frame": _spread(reader.frame_sizes),
            "parts_per_sequence": _spread(_part_counts(reader)),
            "frame_interval": _spread(reader.frame_intervals(), float),
            "fields": [*reader.fields, *(f"activation/{stream}" for stream in reader.file.get("activation", ()))],
            "range": ranges,
            "shifts": {name: shift.tolist() for name, shift in zip(reader.names, reader.shifts) if shift.any()},
            **_who(reader.class_names, reader.labels, reader.splits),
            "subjects": _count(_known(reader.subjects)),
            "cameras": _count(_known(reader.cameras)),
            "skipped": [{"name": name, "reason": reason} for name, reason in reader.skipped],
        }


def _parts(path: Path) -> dict[str, Any]:
    found = _clouds(path)
    with PartsReader(path) as reader:
        found["counts"] |= {"part_slots": reader.num_parts, "frame_pairs": int(reader.pair_counts.sum())}
        found["pairs_per_sequence"] = _spread(reader.pair_counts)
    return found


def _part_counts(reader: CloudsReader) -> np.ndarray:
    """Counts the different parts that the points of each sequence are in, i64 (S); empty when the file has none."""
    if "part" not in reader.fields:
        return np.zeros(0, np.int64)
    ends = np.concatenate([[0], np.cumsum(reader.point_counts)])
    counts = []
    for start, stop in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        ids = reader.file["part"][start:stop]
        counts.append(int(np.count_nonzero(np.bincount(ids[ids >= 0]))))
    return np.array(counts, np.int64)


def _scores(path: Path) -> dict[str, Any]:
    reader = ScoresReader(path)
    return {
        "counts": {"samples": len(reader.names), "classes": len(reader.class_names)},
        "streams": sorted(reader.streams),
        "range": {"scores": _ends(reader.scores)},
        **_who(reader.class_names, reader.labels, reader.splits),
    }


def _statistics(path: Path) -> dict[str, Any]:
    reader = StatisticsReader(path)
    return {
        "counts": {"samples": len(reader.names)},
        "of": str(reader.provenance[-1].get("config", {}).get("task", "")),
        "skipped": [{"name": name, "reason": reason} for name, reason in reader.skipped],
    }


def _embedding(path: Path) -> dict[str, Any]:
    reader = EmbeddingReader(path)
    return {
        "counts": {"samples": len(reader.names), "classes": len(reader.class_names)},
        "streams": sorted(reader.streams),
        "metrics": {
            f"{stream}_{key}": value for stream, said in reader.streams.items() for key, value in said.values.items()
        },
        **_who(reader.class_names, reader.labels, reader.splits),
    }


def _views(path: Path) -> dict[str, Any]:
    with ViewsReader(path) as reader:
        header = reader.header
        track, part = reader.track, reader.part
        centers = header.camera_centers()
    angles = np.rad2deg(
        [np.arctan2(centers[:, 0], centers[:, 2]), np.arctan2(centers[:, 1], np.hypot(*centers[:, ::2].T))]
    )
    fovy = np.rad2deg(2 * np.arctan(0.5 * header.size[1] / header.intrinsics[:, 1, 1]))
    cameras = [
        {
            "view": view,
            "role": role,
            "azimuth": float(azimuth),
            "elevation": float(elevation),
            "radius": float(radius),
            "fovy": float(view_angle),
        }
        for view, (role, azimuth, elevation, radius, view_angle) in enumerate(
            zip(header.role, *angles, np.linalg.norm(centers, axis=1), fovy, strict=True)
        )
    ]
    return {
        "name": header.name,
        "counts": {
            "views": header.num_views,
            "frames": header.num_frames,
            "tracks": 0 if track is None else track.shape[1],
            "parts": 0 if part is None else len(np.unique(part[part >= 0])),
        },
        "size": list(header.size),
        "reference": header.reference,
        "duration": float(header.time[-1] - header.time[0]),
        "frame_interval": _spread(np.diff(header.time), float),
        "fields": list(reader.fields),
        "orbit": cameras,
    }


def _gaussians(path: Path) -> dict[str, Any]:
    scene = read_scene(path)
    low, high = scene.frame_mean.min((0, 1)).tolist(), scene.frame_mean.max((0, 1)).tolist()
    return {
        "counts": {
            "gaussians": scene.num_gaussians,
            "frames": scene.num_frames,
            "parts": scene.num_parts,
            "control_points": len(scene.control_point),
            "cameras": len(scene.camera_intrinsics),
        },
        "size": list(scene.size),
        "reference": scene.reference,
        "sh_degree": scene.sh_degree,
        "duration": float(scene.time[-1] - scene.time[0]),
        "frame_interval": _spread(np.diff(scene.time), float),
        "range": {axis: [a, b] for axis, a, b in zip("xyz", low, high, strict=True)},
        "gaussians_per_part": _count(scene.part),
        "metrics": scene.metrics,
    }


def point_ranges(reader: CloudsReader) -> tuple[dict[str, list[float] | None], int]:
    """Finds the smallest and largest coordinate of each axis, and how many points are not finite (they don't count).

    Reads a fixed number of points at a time, so memory doesn't grow with the file.
    """
    low, high, bad = np.full(3, np.inf), np.full(3, -np.inf), 0
    points = reader.file["points"]
    for start in range(0, len(points), _ROWS):
        block = points[start : start + _ROWS]
        lowest, highest = _column_ends(block)
        if not np.isfinite([lowest, highest]).all():
            finite = np.isfinite(block).all(axis=1)
            bad += int((~finite).sum())
            if not finite.any():
                continue
            lowest, highest = _column_ends(block[finite])
        low, high = np.minimum(low, lowest), np.maximum(high, highest)
    ends = zip("xyz", low.tolist(), high.tolist(), strict=True)
    return {axis: [a, b] if a <= b else None for axis, a, b in ends}, bad


def _column_ends(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns minimum and maximum (3) of the columns of f32 (N,3), N > 0; NaN where one occurs."""
    whole = len(block) // _WIDE * _WIDE
    wide = block[:whole].reshape(-1, _WIDE * 3)  # NumPy reduces long rows many times as fast as rows of three
    ends = [wide.min(axis=0).reshape(-1, 3), wide.max(axis=0).reshape(-1, 3)] if whole else []
    few = np.concatenate([*ends, block[whole:]])
    return few.min(axis=0), few.max(axis=0)


def _spread(values: np.ndarray, kind: type = int) -> dict[str, float] | None:
    if len(values) == 0:
        return None
    return {"min": kind(values.min()), "median": float(np.median(values)), "max": kind(values.max())}


def _ends(values: np.ndarray) -> list[float] | None:
    return [float(values.min()), float(values.max())] if values.size else None


def _known(values: np.ndarray) -> np.ndarray:
    return values[values >= 0]


def _count(values: Iterable[Any]) -> dict[str, int]:
    """Counts how often each value occurs, in the order of the values; keys as text, as JSON requires."""
    return {str(value): count for value, count in sorted(Counter(np.asarray(values).tolist()).items())}


def _who(class_names: list[str], labels: np.ndarray, splits: list[str]) -> dict[str, Any]:
    """Counts the samples of each class, in all and by split; of each split; and how many have no label."""
    names = list(class_names) or [""] * (int(labels.max(initial=-1)) + 1)
    of_label: dict[int, list[str]] = {}
    for split, label in zip(splits, labels.tolist(), strict=True):
        of_label.setdefault(label, []).append(split)
    rows = []
    for label, name in enumerate(names):
        own = of_label.get(label, [])
        rows.append({"label": label, "name": name, "samples": len(own), "splits": _count(own)})
    counts = Counter(splits)
    ordered = sorted(set(splits), key=lambda split: (_SPLITS.index(split) if split in _SPLITS else len(_SPLITS), split))
    return {
        "classes": rows,
        "unknown_labels": int((labels < 0).sum()),
        "splits": {split: counts[split] for split in ordered},
    }
