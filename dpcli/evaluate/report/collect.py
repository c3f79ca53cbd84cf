"""Collects the results that the arguments of a report name: result objects, or scores, parts and videos that are evaluated here."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.report.blocks import Figure, Table
from dpcli.evaluate.report.error_clouds import part_blocks
from dpcli.evaluate.report.video_strips import strip_figure
from dpcli.evaluate.results import KEPT_STATISTICS
from dpcli.evaluate.video.sources.open_source import is_media
from dpcli.store import CloudsReader, PartsReader, file_kind
from dpcli.store.file import MAGIC, is_hdf5
from dpcli.store.pipes import standard_input
from dpcli.text_files import distinct_keys

_EXPECTED = (
    "expected what `dpc evaluate ... --json` prints (one object a line), a scores file, a parts file with --truth, "
    "or a video as PRED=TRUTH"
)
_MAPPINGS = ("metrics", "protocol", "units", "denominators", "intervals", "surface_intervals")
_LISTS = ("left_out", "provenance")
_INSIDE = {"per_class": list, "thresholds": list, "streams": dict}  # of `metrics`, where they are
_VIDEO = ("views", "gaussians")


@dataclass
class CollectedResult:
    """Holds a result object and where it is from; `extras`: figures that only the files behind it could give."""

    found: dict[str, Any]
    source: str
    extras: list[Table | Figure] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class Collected:
    """Holds all results in the order given, and what was given twice."""

    results: list[CollectedResult]
    duplicates: list[str]


def collect(
    arguments: Sequence[str],
    truth: Path | None = None,
    *,
    split: str | None = None,
    pictures: bool = True,
    stdin: BinaryIO | None = None,
) -> Collected:
    """Returns the results of all arguments: files, `-` for a pipe, or `PRED=TRUTH`.

    truth: of the parts files that are named without one. pictures: also what needs the files behind a
    result (clouds, strips). Equal objects count once. Raises DataError for a file that holds no result, UsageError for no
    arguments, a pipe named twice, or a truth that no file is compared with.
    """
    if not arguments:
        raise UsageError("no results to report; " + _EXPECTED)
    if list(arguments).count("-") > 1:
        raise UsageError("- names the pipe, which can be read only once")
    if truth is not None and not any(map(_takes_truth, arguments)):
        raise UsageError(
            f"--truth {truth}: is of parts files, and none is given without a truth of its own; of scores and videos name both"
            " as FILE=TRUTH"
        )
    results = [result for argument in arguments for result in _results_of(argument, truth, split, pictures, stdin)]
    return _drop_repeats(results)


def _results_of(
    argument: str, truth: Path | None, split: str | None, pictures: bool, stdin: BinaryIO | None
) -> list[CollectedResult]:
    if argument == "-":
        return _parse_objects((stdin or standard_input()).read(), "stdin", pictures)
    path, own = _split_pair(argument)
    if path.is_file() and own is None and not is_hdf5(path) and not is_media(path):
        return _parse_objects(path.read_bytes(), str(path), pictures)
    kind = file_kind(path) if path.is_file() and is_hdf5(path) else "video"
    if kind == "scores":
        return [_scores_result(path, own, split)]
    if kind == "parts":
        return _parts_results(path, own or truth, split, pictures)
    if kind in _VIDEO or (own and kind == "video"):
        return [_video_result(path, own, pictures)]
    if kind == "video" and not path.exists():
        raise DataError(f"{path}: no such file; {_EXPECTED}")
    if kind == "statistics":
        raise DataError(f"{path}: {KEPT_STATISTICS}")
    raise DataError(f"{path}: holds {kind!r}, which has no result in it; {_EXPECTED}")


def _takes_truth(argument: str) -> bool:
    """Returns whether that names a parts file alone, which is compared with the truth of all."""
    path, own = _split_pair(argument)
    return own is None and path.is_file() and is_hdf5(path) and file_kind(path) == "parts"


def _split_pair(argument: str) -> tuple[Path, Path | None]:
    """Returns both paths of `PRED=TRUTH`; a file that has an equals sign in its name stays one."""
    if "=" not in argument or Path(argument).exists():
        return Path(argument), None
    cuts = [i for i, letter in enumerate(argument) if letter == "="]
    cut = next((i for i in cuts if Path(argument[:i]).exists() and Path(argument[i + 1 :]).exists()), cuts[0])
    return Path(argument[:cut]), Path(argument[cut + 1 :])


def _parse_objects(data: bytes, source: str, pictures: bool) -> list[CollectedResult]:
    """Returns result objects from text: one object, a list of them, or one on each line."""
    if data.startswith(MAGIC):
        raise DataError(f"{source}: an HDF5 file; save it and name it (the report reads it more than once)")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{source}: neither text nor HDF5 (it begins with {data[:8]!r}); {_EXPECTED}") from None
    if not text.strip():
        raise DataError(f"{source}: empty; {_EXPECTED}")
    results = [CollectedResult(_check_result(own, where), source) for own, where in _objects_in_text(text, source)]
    for result in results:
        if pictures and result.found.get("task") == "video":
            _add_strips(result)
    return results


def _objects_in_text(text: str, source: str) -> list[tuple[Any, str]]:
    try:
        whole = _strict_json(text)
        found = whole if isinstance(whole, list) else [whole]
        return [(own, f"{source}: object {i}" if len(found) > 1 else source) for i, own in enumerate(found, 1)]
    except ValueError:
        pass
    made = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        try:
            made.append((_strict_json(line), f"{source}: line {number}"))
        except ValueError as error:
            shown = line.strip()[:40]
            raise DataError(
                f"{source}: line {number} is not JSON ({error}), it begins with {shown!r}; {_EXPECTED}"
            ) from None
    return made


def _strict_json(text: str) -> Any:
    """Returns what JSON says. Raises ValueError for NaN and Infinity, which no result has."""

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is not a number")

    try:
        return json.loads(text, parse_constant=refuse, object_pairs_hook=distinct_keys)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _check_result(found: Any, where: str) -> dict[str, Any]:
    """Returns the object if it has the structure of a result, of whatever task. Raises DataError if not."""
    if not isinstance(found, dict) or not isinstance(found.get("task"), str):
        shown = (
            f"an object with {', '.join(list(found)[:5]) or 'nothing'}"
            if isinstance(found, dict)
            else f"a {type(found).__name__}"
        )
        raise DataError(f"{where}: {shown}, no result (it has no text `task`); {_EXPECTED}")
    for key in _MAPPINGS:
        if not isinstance(found.get(key, {}), dict):
            raise DataError(f"{where}: {key} is a {type(found[key]).__name__}; expected an object of names and values")
    history = found.get("provenance", [])
    if isinstance(history, list):  # of a comparison: one list for each side
        flat = [entry for own in history for entry in (own if isinstance(own, list) else [own])]
        found = found | {"provenance": [entry for row, entry in enumerate(flat) if entry not in flat[:row]]}
    for key in _LISTS:
        entries = found.get(key, [])
        if not isinstance(entries, list) or not all(isinstance(own, dict) for own in entries):
            raise DataError(f"{where}: {key} is not a list of objects; print the result again")
    lists = [("notes", found), *(("names", entry) for entry in found.get("left_out", []))]
    parts = [
        *((key, found.get("metrics", {}), kind) for key, kind in _INSIDE.items()),
        *((*own, list) for own in lists),
    ]
    for key, own, kind in parts:
        if not isinstance(own.get(key, kind()), kind):
            raise DataError(f"{where}: {key} is a {type(own[key]).__name__}; print the result again")
    return found


def _scores_result(path: Path, truth: Path | None, split: str | None) -> CollectedResult:
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.classification.protocol import evaluate_classification
    from dpcli.evaluate.classification.result_json import classification_json

    report = evaluate_classification(path, truth, split, resampling=Resampling())
    return _collected(classification_json(report, str(path)), path)


def _parts_results(path: Path, truth: Path | None, split: str | None, pictures: bool) -> list[CollectedResult]:
    """Returns segmentation, and motion where the truth has poses or scene flow and the prediction frame pairs that it tells of."""
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.segmentation.motion_protocol import evaluate_motion
    from dpcli.evaluate.segmentation.protocol import evaluate_segmentation
    from dpcli.evaluate.segmentation.result_json import motion_json, segmentation_json

    if truth is None:
        raise UsageError(f"{path}: a parts file is compared with a truth; add --truth CLOUDS, or name it {path}=CLOUDS")
    with CloudsReader(truth) as clouds, PartsReader(path) as predicted:
        moves = bool((predicted.pair_counts > 0).any())
        posed, flows = (field in clouds.fields and moves for field in ("pose", "scene_flow"))
    options = {"split": split, "resampling": Resampling()}
    made = [_collected(segmentation_json(evaluate_segmentation(path, truth, **options), str(path)), path)]
    if posed or flows:
        try:
            made.append(_collected(motion_json(evaluate_motion(path, truth, **options), str(path)), path))
        except DataError as error:
            if posed:
                raise
            made[0].notes.append(f"No motion: {error}.")
    if pictures:
        made[0].extras = part_blocks(path, truth, split=split, motion=posed)
    return made


def _video_result(path: Path, truth: Path | None, pictures: bool) -> CollectedResult:
    from dpcli.evaluate.bootstrap import Resampling
    from dpcli.evaluate.video.comparison import evaluate_video
    from dpcli.evaluate.video.result_json import video_json

    if truth is None:
        raise UsageError(f"{path}: a video is compared with a truth; name both as {path}=TRUTH")
    result = _collected(video_json(evaluate_video(path, truth, resampling=Resampling()), str(path)), path)
    if pictures:
        _add_strips(result)
    return result


def _add_strips(result: CollectedResult) -> None:
    """Adds pictures of the files that the object names, if they are still there; else a note that says why not."""
    protocol = result.found.get("protocol", {})
    predicted, truth = result.found.get("input"), protocol.get("truth")
    if not (
        isinstance(predicted, str) and isinstance(truth, str) and Path(predicted).exists() and Path(truth).exists()
    ):
        result.notes.append("No pictures: the files that were compared are not where the object says.")
        return
    try:
        background = protocol.get("background")
        result.extras.append(
            strip_figure(Path(predicted), Path(truth), protocol=str(protocol.get("name", "dpc")), background=background)
        )
        result.notes.append("The pictures are of the files as they are now.")
    except (DataError, UsageError) as error:
        result.notes.append(f"No pictures: {error}.")


def _collected(found: dict[str, Any], path: Path) -> CollectedResult:
    """Returns the object as its JSON text would be read, so that files and objects make the same page."""
    return CollectedResult(json.loads(json.dumps(found, allow_nan=False)), str(path))


def _drop_repeats(results: list[CollectedResult]) -> Collected:
    kept: dict[str, CollectedResult] = {}
    duplicates = []
    for result in results:
        key = json.dumps(result.found, sort_keys=True)
        if key in kept:
            duplicates.append(
                f"{result.source}: the same {result.found['task']} result as in {kept[key].source}, shown once"
            )
        else:
            kept[key] = result
    return Collected(list(kept.values()), duplicates)
