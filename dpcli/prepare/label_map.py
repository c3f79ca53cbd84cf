"""Label maps: a file says which class of which source becomes which, so that sources with unlike classes can be joined.

    classes = ["wave", "push"]     # optional: the order of the new classes; else as they first appear

    [labels]                       # in all files: old = new
    "high arm wave" = "wave"
    "two hand wave" = "wave"
    "bend" = ""                    # left out

    [files."nvgesture.h5"]         # in one file, by its name; comes before [labels]
    "gesture 07" = "push"

As JSON the same: {"classes": [...], "labels": {...}, "files": {"nvgesture.h5": {...}}}. A class that is not named keeps
its name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.text_files import read_json, read_toml


@dataclass(frozen=True)
class LabelMap:
    """Holds what a label map says; an empty one leaves all names as they are, and then class lists must agree."""

    classes: tuple[str, ...] = ()
    labels: dict[str, str] = field(default_factory=dict)
    files: dict[str, dict[str, str]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> LabelMap:
        """Reads a .toml or .json file. Raises DataError when it is not as the module says."""
        if path.suffix.lower() == ".json":
            content = read_json(path)
        else:
            content = read_toml(path)
        allowed = {"classes": list, "labels": dict, "files": dict}
        if not isinstance(content, dict) or content.keys() - allowed.keys() or not content:
            found = ", ".join(map(str, content)) if content else "nothing"
            raise DataError(f"{path}: holds {found}; expected classes, [labels] or [files.NAME]")
        for key, kind in allowed.items():
            if not isinstance(content.get(key, kind()), kind):
                raise DataError(f"{path}: {key} is {content[key]!r}, expected a {'list' if kind is list else 'table'}")
        tables = [content.get("labels", {}), *content.get("files", {}).values()]
        if any(not isinstance(t, dict) or any(not isinstance(v, str) for v in t.values()) for t in tables):
            raise DataError(f'{path}: a class is mapped to something that is not a name; expected "old" = "new"')
        classes = content.get("classes", [])
        if not all(isinstance(one, str) and one for one in classes) or len(set(classes)) < len(classes):
            raise DataError(f"{path}: classes {classes!r:.80}; expected names, each once")
        return cls(tuple(classes), content.get("labels", {}), content.get("files", {}))

    def resolve(self, sources: Sequence[tuple[Path, list[str]]]) -> tuple[list[str], list[list[int | None]]]:
        """Returns the new classes, and for each (file, its classes) the new number of each of its classes, None = left
        out.

        DataError: the lists disagree and nothing maps them; a name in the map that no file has; a class not in
        `classes`.
        """
        if not (self.classes or self.labels or self.files):
            _require_equal(sources)
        self._refuse_unknown(sources)
        renamed = [[self._new(path, name) for name in names] for path, names in sources]
        order = list(self.classes) or list(dict.fromkeys(new for names in renamed for new in names if new))
        places = {name: place for place, name in enumerate(order)}
        for (path, names), new in zip(sources, renamed):
            for old, name in zip(names, new):
                if name and name not in places:
                    raise DataError(
                        f"{path}: class {old!r} becomes {name!r}, which classes of the label map doesn't list"
                    )
        return order, [[places[name] if name else None for name in names] for names in renamed]

    def _new(self, path: Path, name: str) -> str:
        own = self.files.get(path.name, {})
        return own.get(name, self.labels.get(name, name))

    def _refuse_unknown(self, sources: Sequence[tuple[Path, list[str]]]) -> None:
        known: dict[str, list[str]] = {}
        for path, names in sources:  # several files may have one name
            known.setdefault(path.name, []).extend(names)
        for file, table in self.files.items():
            if file not in known:
                raise DataError(f"label map: no file {file!r} among {', '.join(known)}")
            for old in table.keys() - set(known[file]):
                raise DataError(f"label map: {file} has no class {old!r}; it has {_some(known[file])}")
        everything = [name for names in known.values() for name in names]
        for old in self.labels.keys() - set(everything):
            raise DataError(f"label map: no file has a class {old!r}; they have {_some(everything)}")


def _require_equal(sources: Sequence[tuple[Path, list[str]]]) -> None:
    first_path, first = sources[0]
    for path, names in sources:
        if names != first:
            raise DataError(
                f"{path}: {counted(len(names), 'class')} ({_some(names)}), other than the {len(first)} of {first_path} "
                f"({_some(first)}); --labels map.toml says which is which"
            )


def _some(names: list[str]) -> str:
    shown = ", ".join(repr(name) for name in names[:4])
    return f"{shown}, ..." if len(names) > 4 else shown or "none"
