"""`dpc info`: what is in a file."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from dpcli.cli.options import Json, Picture
from dpcli.errors import DataError, UsageError
from dpcli.standard_streams import printable, rich_console

_SAMPLES, _FRAMES = 8, 8
_CLASSES_SHOWN, _COMMAND_SHOWN, _SAMPLES_SHOWN = 100, 300, 20


def info(
    file: Annotated[
        str,
        typer.Argument(
            help="File of any kind, or - for a pipe; or a model: .safetensors, a training folder, a shipped name."
        ),
    ],
    as_object: Json = False,
    picture: Picture = None,
    samples: Annotated[
        int, typer.Option("--samples", min=1, max=100, help="Rows of the picture; sequences on the page.")
    ] = _SAMPLES,
    frames: Annotated[int, typer.Option("--frames", min=1, max=60, help="Columns of the picture: moments.")] = _FRAMES,
    view: Annotated[
        str | None,
        typer.Option("--view", help="Axes that point right, down and away in the picture, such as xyz or x-zy (z up)."),
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option(
            "--page", help="Write one HTML page (.html) that shows the file in any browser, without a network."
        ),
    ] = None,
    sequence: Annotated[
        list[str] | None,
        typer.Option(
            "--sequence", help="On the page only this sequence: its name or its number from 0; may be repeated."
        ),
    ] = None,
) -> None:
    """Show what is in a file: kind, counts, lengths, classes, splits, ranges, provenance; also as a contact sheet or a page.

    Of a model: its classes, configuration and training.
    """
    from dpcli.runtime.weights import SUFFIX, locate_weights, weights_summary, without_best
    from dpcli.store import input_file
    from dpcli.store.summary import summary

    if sequence and page is None:
        raise UsageError("--sequence chooses what --page shows; give --page FILE.html, too")
    if picture is None and page is None and (samples != _SAMPLES or view is not None):
        option = "--view" if samples == _SAMPLES else "--samples"
        raise UsageError(
            f"{option} is of what --picture or --page shows; give --picture FILE.png or --page FILE.html, too"
        )
    if picture is None and frames != _FRAMES:
        raise UsageError("--frames chooses the columns of --picture; give --picture FILE.png, too")
    model = locate_weights(file, sorted(Path(__file__).parents[1].glob("*/weights")))
    if model is not None and model.suffix == SUFFIX:
        if picture is not None:
            raise UsageError(
                f"--picture draws point clouds and views, {model} holds weights; a training folder has curves.png"
            )
        if page is not None:
            raise UsageError(f"--page shows data files, {model} holds weights; without --page you see what is in it")
        _tell({"file": str(model), **weights_summary(model), **_settings_beside(model)}, as_object, _show_model)
        return
    if model is None and (said := without_best(file)):
        raise DataError(f"{file}: {said}")
    with input_file(file) as path:
        found = {"file": file, **summary(path)}
        if picture is not None:
            _draw(path, found["kind"], picture, samples=samples, frames=frames, view=view)
        if page is not None:
            _write_page(path, found, page, samples=samples, chosen=sequence or [], view=view)
    _tell(found, as_object, _show)


def _write_page(path: Path, found: dict[str, Any], page: Path, **choice: Any) -> None:
    from dpcli.cli.info_page import write_info_page
    from dpcli.runtime.progress import log

    title = "standard input" if found["file"] == "-" else Path(found["file"]).name
    left_out = write_info_page(path, page, title=title, kind=found["kind"], rows=_lines(found), **choice)
    log.info(" ".join([f"{page}: {page.stat().st_size / 1e6:.2g} MB.", *left_out]))


def _settings_beside(model: Path) -> dict[str, Any]:
    """Returns the settings of the run that made the weights, by group, where its folder holds them; dates and NaN, which ours
    never are, as text.
    """
    from dpcli.text_files import read_toml

    file = model.parent / "settings.toml"
    return (
        {"settings": json.loads(json.dumps(read_toml(file), default=str), parse_constant=str)} if file.is_file() else {}
    )


def _tell(found: dict[str, Any], as_object: bool, show: Callable[[dict[str, Any]], None]) -> None:
    if as_object:
        typer.echo(json.dumps(found, allow_nan=False))
    else:
        show(found)


def _draw(path: Any, kind: str, picture: Any, **options: Any) -> None:
    from dpcli.draw.clouds_sheet import clouds_sheet
    from dpcli.runtime.whole_file import FIGURES, check_target
    from dpcli.store import CloudsReader

    if kind not in ("clouds", "parts", "views"):
        other = "a scene: dpc generate4d render" if kind == "gaussians" else "scores: dpc evaluate classification"
        raise UsageError(
            f"--picture draws point clouds and views, this file holds {kind!r}; for {other} --picture FILE"
        )
    check_target(picture, "--picture", FIGURES)
    if kind == "views":
        _draw_views(path, picture, **options)
        return
    with CloudsReader(path) as reader:
        clouds_sheet(reader, picture, **options)


def _draw_views(path: Any, picture: Any, *, samples: int, frames: int, view: str | None) -> None:
    from dpcli.draw.views_sheet import views_sheet
    from dpcli.store.views import ViewsReader

    if view is not None:
        raise UsageError("--view turns point clouds; a file of views has pictures, which stay as they are")
    with ViewsReader(path) as reader:
        views_sheet(reader, picture, samples=samples, frames=frames)


def _show(found: dict[str, Any]) -> None:
    console = rich_console(sys.stdout)
    _print_lines(console, _lines(found), 20)
    if found.get("classes"):
        console.print()
        console.print(_class_table(found), soft_wrap=True)
    for number, entry in enumerate(found["provenance"], 1):
        short = _shortened(str(entry.get("command", "")))
        console.print(f"{'provenance' if number == 1 else '':<20} {number}. {printable(short)}", soft_wrap=True)
    _print_lines(console, _settings_lines(found), 20)


def _print_lines(console: Any, lines: list[tuple[str, str]], width: int) -> None:
    for name, value in lines:
        console.print(printable(f"{name:<{width}} {value}"), soft_wrap=True)


def _settings_lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Returns the settings of the command that made the file, one line a group, where its provenance has them."""
    from dpcli.runtime.settings.value_types import write_text

    groups = found["provenance"][-1].get("config", {}).get("settings", {}) if found["provenance"] else {}
    return [
        (f"settings {group}", ", ".join(f"{name} {write_text(value)}" for name, value in values.items()))
        for group, values in groups.items()
    ]


def _show_model(told: dict[str, Any]) -> None:
    console = rich_console(sys.stdout)
    made = f"dpc {told['version']}, " if told["version"] else ""
    lines = [
        ("file", told["file"]),
        ("kind", f"model, {told['format'] or 'of another program'}, {made}{told['bytes'] / 1e6:.3g} MB"),
        ("weights", f"{told['weights']:,} numbers in {told['tensors']} tensors, {', '.join(told['types'])}"),
    ]
    if told["card"]:
        lines.append(("card", told["card"]))
    for key, value in (told["header"] | told.get("settings", {})).items():
        within = value.items() if isinstance(value, dict) else [("", value)]
        lines += [(f"{key} {name}".replace("_", " ").strip(), _model_value(one)) for name, one in within]
    _print_lines(console, lines, 24)


def _model_value(value: Any) -> str:
    if isinstance(value, list) and value and all(isinstance(one, str) for one in value):  # names of classes
        shown = ", ".join(value[:_CLASSES_SHOWN])
        return f"{len(value)}: {shown}, ..." if len(value) > _CLASSES_SHOWN else f"{len(value)}: {shown}"
    return _shortened(value if isinstance(value, str) else json.dumps(value))


def _shortened(text: str) -> str:
    return text if len(text) <= _COMMAND_SHOWN else text[:_COMMAND_SHOWN] + " ..."


def _lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    kind = f"{found['kind']}, schema {found['schema']}, {found['bytes'] / 1e6:.3g} MB"
    lines = [("file", found["file"]), ("kind", kind)]
    if "counts" in found:
        lines.append(("counts", ", ".join(_count(*one) for one in found["counts"].items())))
    for key, unit in (
        ("frames_per_sequence", ""),
        ("points_per_frame", ""),
        ("parts_per_sequence", ""),
        ("pairs_per_sequence", ""),
        ("frame_interval", " s"),
    ):
        if found.get(key):
            spread = " / ".join(f"{found[key][name]:.6g}" for name in ("min", "median", "max"))
            lines.append((key.replace("_", " "), f"{spread}{unit} (min / median / max)"))
    for axis, ends in found.get("range", {}).items():
        unit = (found["length_unit"] or "") if axis in "xyz" else ""  # a file of others may name none
        behind = f"({unit})" if " " in unit else unit  # `0.2 300 raw depth units` would read as two numbers
        text = f"{ends[0]:.5g} to {ends[1]:.5g} {behind}".rstrip() if ends else "no finite values"
        lines.append((f"range {axis}", text))
    lines += _shift_lines(found.get("shifts", {}))
    for key in ("fields", "streams"):
        if key in found:
            lines.append((key, ", ".join(found[key]) or "none"))
    for key in ("splits", "subjects", "cameras"):
        if found.get(key):
            lines.append((key, ", ".join(f"{name or 'none'} ({count})" for name, count in found[key].items())))
    if found.get("unknown_labels"):
        lines.append(("unknown labels", str(found["unknown_labels"])))
    lines += _first_lines("skipped", [f"{one['name']}: {one['reason']}" for one in found.get("skipped", [])])
    if found["kind"] == "views":
        lines += _view_lines(found)
    elif found["kind"] == "gaussians":
        lines += _scene_lines(found)
    elif found["kind"] == "embedding":
        lines += [(name.replace("_", " "), f"{value:.4g}") for name, value in found["metrics"].items()]
    source = f" from {found['source']}" if found["source"] else ""
    seed = "" if found["seed"] is None else f", seed {found['seed']}"
    maker = "another program" if found["version"] is None else f"dpc {found['version']}"
    return [*lines, ("made by", f"{maker}{source}{seed}")]


def _count(name: str, count: int) -> str:
    """Returns a count with its noun, which `name` has in the plural.

    >>> _count("part_slots", 2400), _count("views", 1), _count("classes", 1)
    ('2,400 part slots', '1 view', '1 class')
    """
    noun = name.replace("_", " ")
    return f"{count:,} {noun.removesuffix('es' if noun == 'classes' else 's') if count == 1 else noun}"


def _shift_lines(shifts: dict[str, list[float]]) -> list[tuple[str, str]]:
    """Returns the lines of shifts: added to the points of its sequence, a shift gives the original coordinates."""
    told = [
        f"{name}: {', '.join(f'{value:.10g}' for value in shift)} (points + shift: the original coordinates)"
        for name, shift in shifts.items()
    ]
    return _first_lines("shift", told)


def _first_lines(name: str, told: list[str]) -> list[tuple[str, str]]:
    """Returns a line for each of the first texts, all under one name, and one that counts the rest."""
    if len(told) > _SAMPLES_SHOWN:
        told = [*told[:_SAMPLES_SHOWN], f"... and {len(told) - _SAMPLES_SHOWN} more; --json lists all"]
    return [(name, text) for text in told]


def _view_lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    lines = [("name", found["name"]), ("size", f"{found['size'][0]}x{found['size'][1]} pixels")]
    lines.append(("duration", f"{found['duration']:.4g} s from the first frame to the last"))
    for camera in found["orbit"]:
        angles = f"azimuth {camera['azimuth'] + 0.0:.1f}, elevation {camera['elevation'] + 0.0:.1f} degrees"
        rest = f"radius {camera['radius']:.4g}, fovy {camera['fovy']:.4g} degrees"
        lines.append((f"view {camera['view']}", f"{camera['role']:<9} {angles}, {rest}"))
    return lines


def _scene_lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    parts = ", ".join(f"{part}: {count:,}" for part, count in found["gaussians_per_part"].items())
    lines = [
        ("size", f"{found['size'][0]}x{found['size'][1]} pixels"),
        ("duration", f"{found['duration']:.4g} s"),
        ("Gaussians by part", parts),
    ]
    return lines + [
        (name, str(value)) for name, value in found["metrics"].items() if isinstance(value, (int, float, str))
    ]


def _class_table(found: dict[str, Any]) -> Any:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    splits = list(found["splits"])
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False)
    for name in ("label", "class", "samples", *(split or "no split" for split in splits)):
        table.add_column(Text(printable(name)), justify="left" if name == "class" else "right", no_wrap=True)
    rows = found["classes"]
    for row in rows[:_CLASSES_SHOWN]:
        counts = [str(row["splits"].get(split, 0)) for split in splits]
        table.add_row(str(row["label"]), Text(printable(row["name"])), str(row["samples"]), *counts)
    if len(rows) > _CLASSES_SHOWN:
        table.add_row("...", Text(f"and {len(rows) - _CLASSES_SHOWN} more classes; --json lists all"))
    return table
