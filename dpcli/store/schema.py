"""The contract's data sets: name, type, shape and meaning of each, by kind of file.

Writers take their types and shapes from here, `file.open_store` checks what it opens against it, and the tables of
docs/format.md are made of it (`python -m dpcli.store.schema docs/format.md`). Imports no HDF5.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.errors import UsageError

SCHEMA = 1
KEPT = "field_"  # what the name of a column begins with that was kept on request
METERS = {  # in each unit of length that is known by the name that `length_unit` has for it
    **{"m": 1.0, "dm": 1e-1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "km": 1e3},
    **{"ft": 0.3048, "in": 0.0254, "us-ft": 1200 / 3937},
}


def taken_for_meters(path: Path, length_unit: str) -> list[str]:
    """Returns a warning for a file whose lengths are used as meters because its unit is none of METERS; else nothing."""
    if length_unit in METERS:
        return []
    unit = repr(length_unit) if length_unit else "not given"
    known = ", ".join(METERS)
    return [f"{path}: its unit of length is {unit}, which counts as 1 m here; convert the data with --unit ({known})"]


_MARKED = re.compile(r"(<!-- fields: (\w+) -->\n).*?(<!-- end of fields -->)", re.DOTALL)


@dataclass(frozen=True)
class Field:
    """Describes one data set of a kind. `kind`: f32, i64, u8, str ...; `shape` has letters for numbers that each file sets.

    group: the name is that of a group with a data set like this for each stream.
    """

    name: str
    kind: str
    shape: tuple[str | int, ...]
    meaning: str
    optional: bool = False
    group: bool = False

    @property
    def dtype(self) -> np.dtype:
        """Returns the type as numpy's. Raises ValueError for strings, whose type is h5py's."""
        if self.kind == "str":
            raise ValueError(f"{self.name}: strings have no numpy type here")
        return np.dtype(f"{self.kind[0]}{int(self.kind[1:]) // 8}")

    @property
    def row(self) -> tuple[str | int, ...]:
        """Returns the shape of one entry along the first axis."""
        return self.shape[1:]

    def in_words(self) -> str:
        """Returns type and shape as the tables and errors have them, such as `f32 (P,3)`."""
        return f"{self.kind} ({','.join(map(str, self.shape))})"


_WHO = (
    Field("name", "str", ("S",), "unique name"),
    Field("split", "str", ("S",), "`train`, `validation`, `test` or empty"),
    Field("label", "i32", ("S",), "class, from 0; -1 unknown"),
)
_CLOUDS = (
    Field("points", "f32", ("P", 3), "x y z in `length_unit`; camera axes are OpenCV's (x right, y down, z forward)"),
    Field("frame_offsets", "i64", ("F+1",), "frame f is `points[frame_offsets[f]:frame_offsets[f+1]]`"),
    Field("sequence_offsets", "i64", ("S+1",), "sequence s is frames `sequence_offsets[s]` to `sequence_offsets[s+1]`"),
    *_WHO,
    Field("subject", "i32", ("S",), "who is seen; -1 unknown"),
    Field("camera", "i32", ("S",), "which camera saw it; -1 unknown"),
    Field("time", "f64", ("F",), "seconds", optional=True),
    Field("color", "u8", ("P", 3), "color, red green blue", optional=True),
    Field("part", "i16", ("P",), "rigid part, from 0; -1 unknown", optional=True),
    Field("track", "i64", ("P",), "identity of a point across frames", optional=True),
    Field(
        "scene_flow",
        "f32",
        ("P", 3),
        "true (or, after `dpc segment estimate-flow`, estimated) displacement of a point to the sequence's next frame,"
        " in its last frame to the one before; for motion that `pose` does not describe (KITTI scene flow)",
        optional=True,
    ),
    Field(
        "pose",
        "f64",
        ("F", "parts", 4, 4),
        "part-to-world, padded with identity to the file's largest number of parts",
        optional=True,
    ),
    Field(
        "joint",
        "f64",
        ("F", "parts", 9),
        "the joint above each part, in the frame's coordinates: parent part (-1: none), type (0 none, 1 revolute, 2"
        " prismatic, 3 fixed, 4 free), direction of the axis x y z, a point on it x y z, value (radians or `length_unit`);"
        " padded as `pose`",
        optional=True,
    ),
    Field(
        "shift",
        "f64",
        ("S", 3),
        "what was subtracted from the coordinates of a sequence because float32 can't hold them (maps, small objects"
        " far away): points plus shift are the original coordinates, divided by any `--scale`. Absent where nothing was subtracted",
        optional=True,
    ),
    Field(f"{KEPT}NAME", "f32", ("P",), "a column of the raw data, kept on request (`--keep-fields NAME`)", True),
)
_LEFT_OUT = (
    Field("skipped", "str", ("n", 2), "name and reason of every sample that was left out", optional=True),
    Field("position", "i64", ("S",), "in a shard: the place of each sample in the whole list", optional=True),
    Field("skipped_position", "i64", ("n",), "in a shard: the same of the samples left out", optional=True),
)
_EXPLAINED = (
    Field("activation", "f32", ("P",), "how active each point is (`dpc classify explain pac`)", True, group=True),
)
_PARTS = (
    Field("part", "i16", ("P",), "predicted part, 0..K-1; -1 = in none"),
    Field("part_probability", "f32", ("P", "K"), "probability of each part, 0..1"),
    Field("pair", "i32", ("Q", 2), "source and target frame inside the sequence"),
    Field("pair_offsets", "i64", ("S+1",), "sequence s has the pairs `pair_offsets[s]` to `pair_offsets[s+1]`"),
    Field(
        "part_motion",
        "f32",
        ("Q", "K", 4, 4),
        "rigid motion of each part: x_target = M x_source; identity for a part the sequence lacks",
    ),
    Field(
        "flow", "f32", ("R", 3), "displacement of the points of a pair's source frame, in their order, in `length_unit`"
    ),
    Field("flow_offsets", "i64", ("Q+1",), "pair q has the rows `flow_offsets[q]` to `flow_offsets[q+1]`"),
)
_SCORES = (
    Field("scores", "f32", ("S", "C"), "class probabilities"),
    *_WHO,
    Field("streams", "f32", ("S", "C"), "the same of one stream of the network", optional=True, group=True),
    Field("rejected", "u8", ("S",), "1 where nothing was recognized (`--reject-below`); scores stay", optional=True),
)
_STATISTICS = (
    Field("name", "str", ("S",), "unique name"),
    Field("statistics", "str", ("S",), "one JSON object: what was counted of the sample"),
)
_EMBEDDING = (
    *_WHO,
    Field("features", "f32", ("S", "D"), "the vector of each video", group=True),
    Field("coordinates", "f32", ("S", 2), "its place in the plane", group=True),
)
_VIEWS = (
    Field("rgba", "u8", ("V", "T", "H", "W", 4), "straight (not premultiplied) alpha; one picture is one chunk, gzip"),
    Field("intrinsics", "f64", ("V", 3, 3), "pixels, which are rectangles (no skew); centers at +0.5"),
    Field("world_to_camera", "f64", ("V", 4, 4), "rigid; camera axes are OpenCV's"),
    Field("time", "f64", ("T",), "seconds, rising"),
    Field("role", "str", ("V",), "`reference` (one: the input of video-to-4D), `train`, `test`"),
    Field(
        "track", "f32", ("T", "M", 3), "true world positions of M points of the object at every frame", optional=True
    ),
    Field("part", "i16", ("M",), "true rigid part or bone of these points, -1 unknown", optional=True),
)
_GAUSSIANS = (
    Field("mean", "f32", ("N", 3), "canonical position"),
    Field("log_scale", "f32", ("N", 3), "natural logarithm of the standard deviations"),
    Field("quaternion", "f32", ("N", 4), "w x y z, unit"),
    Field("opacity_logit", "f32", ("N",), "opacity before the logistic function"),
    Field(
        "sh",
        "f32",
        ("N", "B", 3),
        "spherical harmonics of 3DGS, B = (degree+1)², degree 0 to 3; the color without direction is"
        " 0.5 + 0.28209479 `sh[:, 0]`",
    ),
    Field("time", "f64", ("T",), "seconds, rising"),
    Field("frame_mean", "f32", ("T", "N", 3), "where each Gaussian is in each frame; sizes and opacities stay"),
    Field("frame_quaternion", "f32", ("T", "N", 4), "how each Gaussian is turned in each frame"),
    Field("part", "i16", ("N",), "rigid part, -1 none"),
    Field("part_probability", "f32", ("N", "S"), "probability of each part, 0..1"),
    Field("part_motion", "f32", ("T", "S", 4, 4), "rigid motion of each part, canonical to frame"),
    Field("rigid_weight", "f32", ("T", "N"), "1 = moves with its part, 0 = on its own"),
    Field("control_point", "f32", ("K", 3), "canonical position of a control point"),
    Field("control_radius", "f32", ("K",), "its radius of influence"),
    Field("control_position", "f32", ("T", "K", 3), "where the control points are in each frame"),
    Field("control_quaternion", "f32", ("T", "K", 4), "how they have turned"),
    Field("camera_intrinsics", "f64", ("V", 3, 3), "the cameras it was fitted to, for pictures of `size`"),
    Field("camera_world_to_camera", "f64", ("V", 4, 4), "where these cameras stand"),
)
EVERYWHERE = (
    Field("class_names", "str", ("C",), "names of the classes; may be empty"),
    Field("provenance", "str", ("n",), "one JSON object per command that led here, oldest first"),
)
# What a kind has beside EVERYWHERE; a `parts` file has all that a `clouds` file has, with a `part` of its own.
TABLES = {
    "clouds": _CLOUDS + _LEFT_OUT + _EXPLAINED,
    "views": _VIEWS,
    "scores": _SCORES + _LEFT_OUT,
    "parts": _PARTS,
    "gaussians": _GAUSSIANS,
    "embedding": _EMBEDDING,
    "statistics": _STATISTICS + _LEFT_OUT,
}
KINDS = tuple(TABLES)


def fields_of(kind: str) -> dict[str, Field]:
    """Returns all data sets that a file of a kind may have, by name. Raises KeyError for a kind that doesn't exist.

    >>> fields_of("parts")["pair"].in_words(), fields_of("parts")["points"].dtype
    ('i32 (Q,2)', dtype('float32'))
    """
    base = TABLES["clouds"] if kind == "parts" else ()
    return {field.name: field for field in (*EVERYWHERE, *base, *TABLES[kind])}


def kept_name(column: str) -> str:
    """Returns the name of the data set of a column that was kept; a slash would make a group of it.

    >>> kept_name("v [m/s]")
    'field_v [m_s]'
    """
    return KEPT + column.replace("/", "_")


def kept_names(columns: Sequence[str]) -> tuple[str, ...]:
    """Returns the names of the data sets of these columns. Raises UsageError where two of them would be one data set."""
    names = tuple(map(kept_name, columns))
    for place, name in enumerate(names):
        first = names.index(name)
        if first < place:
            raise UsageError(
                f"--keep-fields: {columns[first]} and {columns[place]} would both be kept as {name}; keep one, or rename one"
            )
    return names


def find_field(known: dict[str, Field], name: str) -> Field | None:
    """Returns what a kind, whose fields are `known`, says of a data set of that name; None where it says nothing."""
    return known.get(f"{KEPT}NAME" if name.startswith(KEPT) else name)


def table(kind: str) -> str:
    """Returns the data sets of a kind as a table in markdown, one a line."""
    rows = [(f"{field.name}/STREAM" if field.group else field.name, field) for field in TABLES[kind]]
    lines = [
        f"| `{name}` | {field.in_words()}{', optional' if field.optional else ''} | {field.meaning} |\n"
        for name, field in rows
    ]
    return "".join(["| data set | type, shape | meaning |\n", "|---|---|---|\n", *lines])


def fill_tables(text: str) -> str:
    """Returns a page with the tables between its marks `<!-- fields: KIND -->` and `<!-- end of fields -->` made anew."""
    return _MARKED.sub(lambda found: f"{found[1]}{table(found[2])}{found[3]}", text)


if __name__ == "__main__":
    import sys

    for page in map(Path, sys.argv[1:]):
        page.write_text(fill_tables(page.read_text()))
