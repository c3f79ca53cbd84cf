"""Says what the names of columns mean: which hold x, y and z and in which unit, which a color, which number frames."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dpcli.errors import DataError

_SPELLED = {
    **{word: "m" for word in ("m", "meter", "meters", "metre", "metres")},
    **{word: "mm" for word in ("mm", "millimeter", "millimeters", "millimetre", "millimetres")},
    **{word: "cm" for word in ("cm", "centimeter", "centimeters", "centimetre", "centimetres")},
    **{word: "ft" for word in ("ft", "foot", "feet")},
    **{word: "in" for word in ("inch", "inches")},
    **{word: "um" for word in ("um", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres")},
    **{"km": "km", "dm": "dm"},
}
_UNITS_OF_TIME = (
    (1.0, "s sec secs second seconds"),
    (1e-3, "ms msec msecs milli millis millisec millisecs millisecond milliseconds"),
    (1e-6, "us usec usecs micro micros microsec microsecs microsecond microseconds"),
    (1e-9, "ns nsec nsecs nano nanos nanosec nanosecs nanosecond nanoseconds"),
    (60.0, "minute minutes"),
    (3600.0, "hour hours hr hrs"),
    (86_400.0, "days"),
)
SECONDS = {word: size for size, words in _UNITS_OF_TIME for word in words.split()}
_IN_BRACKETS = {"min": 60.0, "mins": 60.0, "h": 3600.0, "d": 86_400.0, "day": 86_400.0}  # other things elsewhere
_ABOUT_POINTS = frozenset(
    "point points pt pos position coord coords coordinate coordinates cartesian cart field fields loc location data p"
    " xyz local world global axis vertex koord koordinate koordinaten coordonnée coordonnées".split()
)
_ABOUT_COLORS = frozenset(
    "diffuse color colour colors colours col vertex rgb scalar field channel point points".split()
)
_MAP_NAMES = (("easting", "east"), ("northing", "north"), ("elevation", "height", "altitude", "z"))
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("rf", "gf", "bf"))
_PACKED = ("rgb", "rgba", "rgb24", "rgba32")
_TOLD = re.compile(
    r"(?:\b|_)(?:units?|coordinates|lengths)\b(?:\s*[:=]\s*|\s+(?:are\s+|is\s+)?)(?:in\s+)?"
    r"(?:(?P<size>\d*\.?\d+(?:e-?\d+)?|10\^-?\d+)\s+)?[\[(]?(?P<unit>[a-z]+)\b(?!\s*/)",
    re.IGNORECASE,
)
_IN_WORDS = re.compile(  # "x, y, z in mm", but no "resolution in mm"
    r"^[^a-z]*(?:(?:comment|obj_info|all|the|values|points?|positions?|vertices|vertex|data|are|is|given|stored|measured|x|y|z|xyz"
    r"|and)\b[^a-z]*)+\bin\s+[\[(]?(?P<unit>[a-z]+)\b(?!\s*/)",
    re.IGNORECASE,
)
_UNTOLD = frozenset(
    "1 - none no unit units unitless dimensionless unknown na n/a raw normalized arbitrary a.u. au".split()
)
NO_LENGTH = (
    "sequences or frames whose attribute units says {}, no length that is known: taken for the output's unit (--scale)"
)
_METERS = {1e-6: "um", 1e-3: "mm", 1e-2: "cm", 1e-1: "dm", 1.0: "m", 1e3: "km"}  # as netCDF writes them: 1e-3 m
_MICRO = re.compile("[\u00b5\u03bc]")  # two letters look like a micro sign
_WORD = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+(?![^\W\d_A-Z])|\d+")
_FRAME = re.compile(
    r"#?(frame|scan|sweep|image|cloud)s?[ _.-]?(id|ids|no|nr|num|number|idx|index|count|counter|seq|#|№)?[.]?",
    re.IGNORECASE,
)

ROWS_ARE_FRAMES = "where a row is a frame, and three columns each are a point, give --track columns"
_RECORDING = re.compile(
    r"#?(sequence|seq|recording|record|rec|video|take|trial|session|run|clip|episode|scene|file)s?"
    r"[ _.-]?(id|ids|no|nr|num|number|idx|index|name|#|№)?[.]?",
    re.IGNORECASE,
)


def words_of(name: str) -> list[str]:
    """Returns the words of a column's name in small letters.

    >>> words_of("posX [mm]"), words_of("Points:0"), words_of("//X"), words_of("detected_object.y_m")
    (['pos', 'x', 'mm'], ['points', '0'], ['x'], ['detected', 'object', 'y', 'm'])
    >>> words_of("x [µm]"), words_of("Höhe")  # a letter beyond ASCII ends no word: "m" alone would be meters
    (['x', 'um'], ['höhe'])
    """
    plain = _MICRO.sub("u", name)
    plain = re.sub(r"""[\[(]("|''|\u2033)[\])]""", "(inch)", plain)
    return [word.lower() for word in _WORD.findall(plain)]


def find_axes(names: Sequence[str]) -> tuple[list[int], str] | None:
    """Returns the places of x, y and z among the names, and their unit ("" where they name none); None without them.

    A plain ``x`` goes before ``pos_x``. Raises DataError when several names say the same, so that none can be chosen.
    """
    ranked = [[_axis(name) for name in names], _map_axes(names), _numbered_axes(names)]
    for level in range(3):
        found = [[place for place, axis in enumerate(ranked[0]) if axis and axis[:2] == (k, level)] for k in range(3)]
        if any(len(places) > 1 for places in found):
            twice = next(places for places in found if len(places) > 1)
            raise DataError(
                f"columns {', '.join(names[place] for place in twice)} could each be {'xyz'[found.index(twice)]};"
                " leave one of them in the file, or call it by that letter"
            )
        if all(found):
            units = {ranked[0][places[0]][2] for places in found}  # type: ignore[index]
            return [places[0] for places in found], one_unit(units)
    for axes in ranked[1:]:
        found = [[place for place, axis in enumerate(axes) if axis == k] for k in range(3)]
        if all(len(places) == 1 for places in found):
            return [places[0] for places in found], one_unit({unit_of(names[places[0]]) for places in found})
    return None


class Table(ABC):
    """Offers the columns of a table in a file.

    names: of the columns, none where the file names none. unit: of the coordinates, "" where nothing tells it. cut: notes of
    what is odd about its numbers.
    """

    path: Path
    names: tuple[str, ...]
    unit: str
    cut: dict[str, int]

    @abstractmethod
    def columns(self, places: Sequence[int]) -> np.ndarray:
        """Returns some columns as numbers f64 (N,k), NaN where a cell is empty. Raises DataError where they hold none."""

    @abstractmethod
    def words(self, place: int) -> list[str]:
        """Returns the cells of a column as text, "" of an empty one."""

    @abstractmethod
    def moments(self, place: int) -> np.ndarray | None:
        """Returns the seconds f64 (N) since the first of a column whose type is time, or of numbers in what the file calls a
        unit of time, NaN where it is empty; None of others.
        """


class TypedTable(Table):
    """Holds a table whose columns have types, and so all the digits of their numbers, and may have attributes.

    units: what these say of the units of some columns, and of the whole table by "". Raises DataError for x, y and z in
    different units.
    """

    def __init__(self, path: Path, names: Sequence[str], units: Mapping[str, str]) -> None:
        self.path, self.names, self.units = path, tuple(names), units
        self.unit = unit_of_attributes(path, axes_in(self.names), units)
        self.cut = note_of_units(axes_in(self.names), units)


def axes_in(names: Sequence[str]) -> list[str]:
    """Returns the names of x, y and z among others, [] where none or several could be these, which reading says."""
    try:
        places, _ = find_axes(names) or ([], "")
    except DataError:
        return []
    return [names[place] for place in places]


def unit_of(name: str) -> str:
    """Returns the unit that a name ends with, as in `store.schema.METERS`, "" where it says none."""
    words = words_of(name)
    if re.search(r"[\[(]in[\])]$", name.strip()):  # without brackets a word like others
        return "in"
    return _SPELLED.get(words[-1], "") if len(words) > 1 else ""


def seconds_in_brackets(unit: str) -> float:
    """Returns how many seconds a unit of time is that stands in brackets, or in a row of units; 0 of what is none.

    >>> seconds_in_brackets("ms"), seconds_in_brackets("min"), seconds_in_brackets("mm")
    (0.001, 60.0, 0.0)
    """
    return _IN_BRACKETS.get(unit, SECONDS.get(unit, 0.0))


def unit_of_comments(lines: Iterable[str]) -> str:
    """Returns the unit that comments of a file's header tell, "" where they tell none, or several.

    >>> unit_of_comments(["comment made by hand", "obj_info units = mm"]), unit_of_comments(["# unit: none"])
    ('mm', '')
    >>> unit_of_comments(["comment x, y, z in mm"]), unit_of_comments(["comment accuracy of points in mm"])
    ('mm', '')
    >>> unit_of_comments(["units: 1e-3 m"]), unit_of_comments(["units: 0.01 m"]), unit_of_comments(["units: 7 m"])
    ('mm', 'cm', '')
    >>> unit_of_comments(["units: \u00b5m"]), unit_of_comments(["units: in"]), unit_of_comments(["units: m/s"])
    ('um', 'in', '')
    """
    plain = [_MICRO.sub("u", line) for line in lines]
    found = [_TOLD.search(line) or _IN_WORDS.search(line) for line in plain]
    told = {_unit_of_match(**match.groupdict()) for match in found if match} - {""}
    return told.pop() if len(told) == 1 else ""


def _unit_of_match(unit: str, size: str | None = None) -> str:
    known = (_SPELLED | {"in": "in"}).get(unit.lower(), "")  # where no other word follows
    number = float((size or "1").lower().replace("10^", "1e"))
    return known if number == 1 else _METERS.get(number, "") if known == "m" else ""


def first_unit(told: Iterable[str]) -> str:
    """Returns the first unit that one of some attributes tells, "" where none does.

    >>> first_unit(["", "seconds", "in", "mm"]), first_unit([])
    ('in', '')
    """
    return next((unit for text in told if (unit := unit_of_comments([f"units: {text}"]))), "")


def unit_of_attributes(path: Path, names: Iterable[str], told: Mapping[str, str]) -> str:
    """Returns the unit that attributes of some columns tell, else that of their whole table; "" where they tell none.

    names: of the columns that hold coordinates. told: what is said of columns by name, and of the table by "". Raises DataError
    where columns differ.

    >>> unit_of_attributes(Path("a"), "xyz", {"": "m", "t": "ms", "x": "mm", "y": "mm"})
    'mm'
    """
    for some in (names, [""]):
        if units := {unit_of_comments([f"units: {told.get(name, '')}"]) for name in some} - {""}:
            try:
                return one_unit(units)
            except DataError as error:
                raise DataError(f"{path}: {error}") from None
    return ""


def note_of_units(names: Iterable[str], told: Mapping[str, str]) -> dict[str, int]:
    """Returns a note where attributes of columns with coordinates, or else of their whole table, tell a unit that is no known
    length; {} where they tell one or none, or the names do. names and told: as `unit_of_attributes` has them.

    >>> list(note_of_units("xy", {"x": "degrees_east", "y": "m"})) == [NO_LENGTH.format("'degrees_east'")]
    True
    >>> note_of_units("x", {"x": "mm", "": "pixels"}), note_of_units(["x_mm"], {"x_mm": "pixels"}), note_of_units("x", {"": "1"})
    ({}, {}, {})
    """
    names = [name for name in names if not unit_of(name)]
    own = [told[name] for name in names if name in told] or ([told[""]] if names and "" in told else [])
    strange = [
        unit for unit in own if unit.strip().lower() not in {"", *_UNTOLD} and not unit_of_comments([f"units: {unit}"])
    ]
    return {NO_LENGTH.format(", ".join(repr(unit[:40]) for unit in dict.fromkeys(strange))): 1} if strange else {}


def one_unit(units: set[str]) -> str:
    """Returns the only one of the units. Raises DataError where there are several."""
    if len(units) > 1:
        raise DataError(f"x, y and z have different units ({', '.join(sorted(unit or 'none' for unit in units))})")
    return units.pop()


def _axis(name: str) -> tuple[int, int, str] | None:
    """Returns axis (0 to 2), how plainly the name says it (0: best), and the unit."""
    words = words_of(name)
    unit = unit_of(name)
    rest = words[:-1] if unit else words
    rest = rest[:-1] if unit and rest[-1:] == ["in"] else rest  # "x in mm"
    first_return = rest[-1:] == ["1"]  # as lidars call it that report two
    rest = rest[:-1] if first_return else rest
    letters = [word for word in rest if word in ("x", "y", "z")]
    others = [word for word in rest if word not in ("x", "y", "z")]
    turned = re.match(r"\W*[-\u2212]", name)  # "-y" holds the opposite of y
    if turned or len(letters) != 1 or not set(others) <= _ABOUT_POINTS:
        return None
    return "xyz".index(letters[0]), 2 if others or first_return else 1 if unit else 0, unit


def _map_axes(names: Sequence[str]) -> list[int | None]:
    def axis(name: str) -> int | None:
        words = words_of(name)
        return next((k for k, known in enumerate(_MAP_NAMES) if words and words[0] in known), None)

    return [axis(name) for name in names]


def _numbered_axes(names: Sequence[str]) -> list[int | None]:
    """Returns axes of names such as ``Points:0``, as ParaView writes them."""

    def axis(name: str) -> int | None:
        *rest, last = words_of(name) or [""]
        known = set(rest) <= {*_ABOUT_POINTS, "m"}
        return int(last) if last in ("0", "1", "2") and rest and known else None

    return [axis(name) for name in names]


def find_colors(names: Sequence[str]) -> list[int]:
    """Returns the places of red, green and blue among the names, or of the one that holds all three; [] without."""
    plain = [
        [word for word in words_of(name) if word not in _ABOUT_COLORS] if "%" not in name else [] for name in names
    ]
    for trio in _COLORS:
        places = [[place for place, words in enumerate(plain) if words == [color]] for color in trio]
        if all(places):
            return [own[0] for own in places]
    return [place for place, name in enumerate(names) if name.strip().lower() in _PACKED][:1]


def find_frame_column(names: Sequence[str]) -> str | None:
    """Returns the one name that says it numbers frames, None when none or several do."""
    found = [name for name in names if _FRAME.fullmatch(name.strip())]
    plain = [name for name in found if name.strip().lower().startswith(("frame", "#frame"))] or found
    return plain[0] if len(plain) == 1 else None


def find_recording_columns(names: Sequence[str]) -> list[str]:
    """Returns the names that say they tell recordings apart.

    >>> find_recording_columns(["frame", "Video", "x", "recording_id", "track"])
    ['Video', 'recording_id']
    """
    return [name for name in names if _RECORDING.fullmatch(name.strip())]


def find_trios(names: Sequence[str]) -> dict[tuple[str, ...], list[str]]:
    """Returns the columns of which three differ in one word only, x, y and z, by their other words, as of tables with several
    points in a row.

    >>> find_trios(["frame", "x2", "y2", "z2", "hand.X", "hand.Y", "hand.Z", "snr"])
    {('2',): ['x2', 'y2', 'z2'], ('hand',): ['hand.X', 'hand.Y', 'hand.Z']}
    """
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for name in names:
        words = words_of(name)
        axes = [word for word in words if word in ("x", "y", "z")]
        if len(axes) == 1:
            found.setdefault(tuple(word for word in words if word != axes[0]), {})[axes[0]] = name
    return {others: list(trio.values()) for others, trio in found.items() if len(trio) == 3}


def find_further_points(unread: Sequence[str]) -> list[str]:
    """Returns the first three columns, of those that were not read, that hold another point of the row; [] without.

    >>> find_further_points(["x2", "y2", "z2"]), find_further_points(["acc_x", "acc_y", "acc_z"])
    (['x2', 'y2', 'z2'], [])
    """
    trios = find_trios(unread).items()
    return next((trio for others, trio in trios if all(w.isdecimal() or w in _ABOUT_POINTS for w in others)), [])
