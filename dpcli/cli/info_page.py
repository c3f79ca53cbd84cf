"""`dpc info FILE --page`: reads what a page shows of a file and hands it, as arrays, to the room that draws."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.standard_streams import printable

if TYPE_CHECKING:
    from dpcli.draw.page.points import PageFacts, PageSequence
    from dpcli.store import CloudsReader

PAGES = (".html", ".htm")
_many = partial(counted, form=",")
_PICTURES, _SIDE = 480, 256  # pictures on a page of views; pixels of the longer side


def write_info_page(
    path: Path,
    page: Path,
    *,
    title: str,
    kind: str,
    rows: Sequence[tuple[str, str]],
    samples: int,
    chosen: Sequence[str],
    view: str | None,
) -> list[str]:
    """Writes a page about the file of a kind and returns what it leaves out, in sentences.

    rows: facts (name, value) for its panel. samples: most sequences of a page of clouds. chosen: only these sequences, by name or
    number. view: axes that point right, down and away. Raises UsageError for a wrong choice, DataError when the
    page can't be written.
    """
    from dpcli.draw.page.assemble import write_page
    from dpcli.runtime.whole_file import check_target

    check_target(page, "--page", PAGES)
    if kind == "statistics":
        raise UsageError(
            f"--page: {path.name} holds statistics, which have no page; `dpc evaluate segmentation` or `motion` prints what"
            " follows from them, and `dpc evaluate report` makes a page of that"
        )
    if kind not in ("clouds", "parts") and (chosen or view):
        option = "--sequence" if chosen else "--view"
        raise UsageError(f"{option} is of point clouds, this file holds {kind!r}; leave it out")
    facts = _facts(path, title, rows)
    if kind == "gaussians":
        _write_scene(path, page, facts.title)
        return []
    make = {"clouds": _clouds, "parts": _clouds, "views": _views, "scores": _scores, "embedding": _embedding}[kind]
    choice = {"samples": samples, "chosen": chosen, "view": view} if make is _clouds else {}
    write_page(make(path, facts, **choice), page)
    return facts.notes


def _facts(path: Path, title: str, rows: Sequence[tuple[str, str]]) -> PageFacts:
    from dpcli.draw.page.points import PageFacts
    from dpcli.store.file import open_store, read_provenance

    with open_store(path) as file:
        history = read_provenance(file)
    shown = [(name, printable(value)) for name, value in rows if name != "file"]
    commands = [{"command": printable(str(entry.get("command", "")))} for entry in history]
    return PageFacts(printable(title), "", rows=shown, history=commands)


def _write_scene(path: Path, page: Path, title: str) -> None:
    from dpcli.generate4d.viewer import write_page
    from dpcli.store.gaussians import read_scene
    from dpcli.store.summary import summary

    write_page(read_scene(path), page, title=title, history=summary(path)["provenance"])


def _clouds(path: Path, facts: PageFacts, *, samples: int, chosen: Sequence[str], view: str | None) -> str:
    from dpcli.draw.page.points import frame_budget, point_budget, points_page
    from dpcli.draw.sheet import spread_evenly
    from dpcli.draw.view import default_view, parse_view
    from dpcli.store import CloudsReader

    with CloudsReader(path) as reader:
        seen = parse_view(view or default_view(reader.length_unit, reader.provenance))
        axes = seen * np.array([[1], [-1], [-1]], np.float32)
        rows = _chosen(reader, chosen, samples)
        frames = {row: spread_evenly(int(reader.frame_counts[row]), frame_budget(len(rows))) for row in rows}
        most = point_budget(sum(map(len, frames.values())))
        sequences = [_sequence(reader, row, frames[row], most, axes) for row in rows]
        kind = str(reader.attributes["dpc_kind"])
        facts.subtitle = _cloud_words(reader, kind)
        facts.notes = _left_out(reader, frames, most, bool(chosen))
        return points_page(facts, sequences, axes=axes.T, unit=_short_unit(reader.length_unit))


def _short_unit(unit: str) -> str:
    return unit if len(unit) <= 12 else ""  # a description of coordinates, such as (row, column), is no unit


def _chosen(reader: CloudsReader, chosen: Sequence[str], samples: int) -> list[int]:
    """Returns the sequences to show: those named (by name, else by number), else some of each class."""
    from dpcli.draw.clouds_sheet import spread_samples
    from dpcli.errors import DataError

    if not len(reader):
        raise DataError(f"{reader.path}: no sequences to show")
    if not chosen:
        return spread_samples(reader.labels, samples)
    places = {name: row for row, name in enumerate(reader.names)}
    rows = []
    for word in chosen:
        number = int(word) if word.isascii() and word.isdecimal() and word not in places and len(word) < 10 else -1
        if word not in places and not 0 <= number < len(reader):
            near = get_close_matches(word, reader.names, 1) or reader.names[:1]
            raise UsageError(
                f"--sequence {word}: no such sequence in {reader.path}; expected a name such as {near[0]!r},"
                f" or a number from 0 to {len(reader) - 1}"
            )
        rows.append(places.get(word, number))
    return list(dict.fromkeys(rows))


def _sequence(reader: CloudsReader, row: int, frames: list[int], most: int, axes: np.ndarray) -> PageSequence:
    """Reads a sequence one frame at a time and keeps `most` points of each."""
    from dpcli.draw.page.points import PageSequence
    from dpcli.draw.sheet import spread_evenly

    fields = [name for name in ("part", "color", "time") if name in reader.fields]
    kept: dict[str, list[np.ndarray]] = {name: [] for name in ("points", *fields)}
    for frame in frames:
        own = reader.read(row, [frame], fields)
        some = spread_evenly(len(own.points), most)
        kept["points"].append(own.points[some] @ axes.T)
        for name in fields:
            kept[name].append(own.time if name == "time" else getattr(own, name)[some])
    label = int(reader.labels[row])
    name = reader.class_names[label] if 0 <= label < len(reader.class_names) else ""
    title = " · ".join(word for word in (printable(reader.names[row]), printable(name), reader.splits[row]) if word)
    return PageSequence(
        title,
        frames,
        int(reader.frame_counts[row]),
        kept["points"],
        time=np.concatenate(kept["time"]) if "time" in kept else None,
        part=kept.get("part"),
        color=kept.get("color"),
        label=label,
        class_name=printable(name),
    )


def _cloud_words(reader: CloudsReader, kind: str) -> str:
    sizes = reader.frame_sizes
    about = "" if len(set(sizes.tolist())) < 2 else "about "
    usual = f"{about}{_many(int(np.median(sizes)) if len(sizes) else 0, 'point')} a frame"
    words = [kind, _many(len(reader), "sequence"), _many(int(reader.frame_counts.sum()), "frame"), usual]
    return " · ".join([*words, *([_many(len(reader.class_names), "class")] if reader.class_names else [])])


def _left_out(reader: CloudsReader, frames: dict[int, list[int]], most: int, chosen: bool) -> list[str]:
    """Returns sentences about the sequences, frames and points of the file that the page doesn't show."""
    notes = []
    if len(frames) < len(reader):
        how = "" if chosen else "; --samples N or --sequence NAME shows others"
        notes.append(f"Showing {len(frames):,} of {len(reader):,} sequences{how}.")
    counts = reader.frame_counts[list(frames)]
    longest = int(counts.max())
    shown = max(map(len, frames.values()))
    if shown < longest:
        notes.append(f"Showing {shown:,} of up to {longest:,} frames of a sequence, evenly spread.")
    ends = np.cumsum(reader.frame_counts)
    largest = max(int(reader.frame_sizes[end - count : end].max()) for end, count in zip(ends[list(frames)], counts))
    if most < largest:
        notes.append(f"Showing {most:,} of up to {largest:,} points a frame.")
    return notes


def _views(path: Path, facts: PageFacts) -> str:
    from dpcli.draw.page.film import PageView, film_page
    from dpcli.draw.sheet import spread_evenly
    from dpcli.draw.views_sheet import view_title
    from dpcli.store.views import ViewsReader

    with ViewsReader(path) as reader:
        header = reader.header
        views = spread_evenly(header.num_views, _PICTURES // 8)
        if header.reference not in views:
            views = [header.reference, *views[1:]]
        views.sort(key=lambda view: view != header.reference)
        frames = spread_evenly(header.num_frames, max(_PICTURES // len(views), 8))
        facts.subtitle = " · ".join(
            [
                f"views of {printable(header.name)}",
                _many(header.num_views, "camera"),
                _many(header.num_frames, "frame"),
                f"{header.size[0]}×{header.size[1]} pixels",
            ]
        )
        for word, shown, there in (("cameras", views, header.num_views), ("frames", frames, header.num_frames)):
            if len(shown) < there:
                facts.notes.append(f"Showing {len(shown):,} of {there:,} {word}, evenly spread.")
        if max(header.size) > _SIDE:
            facts.notes.append(f"Pictures are reduced to {_SIDE} pixels.")
        made = (PageView(view_title(reader, view), (reader.rgba(view, frame) for frame in frames)) for view in views)
        return film_page(
            facts, made, frames=frames, frame_count=header.num_frames, time=header.time[frames], side=_SIDE
        )


def _scores(path: Path, facts: PageFacts) -> str:
    from dpcli.draw.page.table import scores_page
    from dpcli.store import ScoresReader

    reader = ScoresReader(path)
    facts.subtitle = f"scores · {_many(len(reader.names), 'sample')} · {_many(len(reader.class_names), 'class')}"
    names = [printable(name) for name in reader.class_names]
    return scores_page(
        facts,
        [printable(name) for name in reader.names],
        names,
        reader.labels,
        reader.scores,
        splits=reader.splits,
        streams=reader.streams,
    )


def _embedding(path: Path, facts: PageFacts) -> str:
    from dpcli.draw.page.scatter import scatter_page
    from dpcli.store.embedding import EmbeddingReader

    reader = EmbeddingReader(path)
    facts.subtitle = f"embedding · {_many(len(reader.names), 'sample')} · {_many(len(reader.class_names), 'class')}"
    planes = {printable(name): (said.coordinates, said.values) for name, said in reader.streams.items()}
    names = [printable(name) for name in reader.class_names]
    return scatter_page(facts, [printable(name) for name in reader.names], names, reader.labels, planes)
