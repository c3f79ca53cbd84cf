"""The video report as tables, notes and data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from dpcli.evaluate.classification.protocol import intervals_json, samples_json
from dpcli.evaluate.classification.tables import TextTable, resampling_note
from dpcli.evaluate.proportions import divide
from dpcli.evaluate.video.comparison import VideoReport, ViewScore, view_values
from dpcli.evaluate.video.image_metrics import PSNR_CAP
from dpcli.evaluate.video.network_metrics import TITLES as LEARNED_TITLES
from dpcli.evaluate.video.network_metrics import LearnedScore
from dpcli.evaluate.video.part_discovery import PART_NEIGHBORS, SOLID, TRACK_NEIGHBORS, PartScore, TrackScore
from dpcli.evaluate.video.protocol import PICTURE_METRICS, choices

TITLES = {"psnr": "PSNR (dB)", "psnr_foreground": "PSNR on object (dB)", "ssim": "SSIM", "ms_ssim": "MS-SSIM"}
_UNITS = {"psnr": "dB", "psnr_foreground": "dB", "ssim": "1", "ms_ssim": "1"}
_NAMES_SHOWN = 10


def video_tables(report: VideoReport) -> list[TextTable]:
    """One row for each view, each role with more than one view, and all; then parts and tracks where they were asked."""
    made = [_pictures(report)] if report.views else []
    if report.learned or report.missing:
        made.append(_learned(report))
    if report.intervals:
        made.append(_intervals(report))
    if "parts" in report.scene:
        made.append(_parts(report.scene["parts"]))
    if "tracks" in report.scene:
        made.append(_tracks(report.scene["tracks"], report.length_unit))
    return made


def _pictures(report: VideoReport) -> TextTable:
    names = [name for name in report.names if name in PICTURE_METRICS]
    header = ["view", "role", "frames", *(TITLES[name] for name in names), "worst frame"]
    rows = [
        [
            view.title,
            view.role,
            str(view.metrics.frames),
            *_cells(asdict(view.metrics), names),
            str(view.metrics.worst) if view.metrics.worst >= 0 else "-",
        ]
        for view in report.views
    ]
    for role, means in report.roles.items():
        several = [view for view in report.views if view.role == role]
        if 1 < len(several) < len(report.views):
            rows.append([f"mean of {len(several)}", role, _frames(several), *_cells(means, names), ""])
    if len(report.views) > 1:
        rows.append([f"mean of {len(report.views)}", "all", _frames(report.views), *_cells(report.mean(), names), ""])
    return TextTable(f"Pictures, protocol {report.protocol.name}", header, rows)


def _learned(report: VideoReport) -> TextTable:
    header, rows = ["metric", "value", "the truth's own", "of"], []
    for name in (name for name in report.names if name in LEARNED_TITLES):
        if name in report.missing:
            rows.append([LEARNED_TITLES[name], "-", "", "not computed"])
            continue
        score = report.learned[name]
        own = "" if score.truth is None else _number(score.truth)
        rows.append([LEARNED_TITLES[name], _number(score.value), own, _counts(score)])
    return TextTable(f"Learned and temporal metrics, protocol {report.protocol.name}", header, rows)


def _intervals(report: VideoReport) -> TextTable:
    means = report.mean() | {name: score.value for name, score in report.learned.items()}
    titles = TITLES | LEARNED_TITLES
    rows = [
        [titles[name], _number(means[name]), f"{own.low:.4g} - {own.high:.4g}" if own.defined else "-"]
        for name, own in report.intervals.items()
    ]
    return TextTable("All views", ["metric", "mean", f"{100 * report.resampling.confidence:.4g} % interval"], rows)


def _counts(score: LearnedScore) -> str:
    return ", ".join(f"{count} {name}" for name, count in score.counts.items())


def _frames(views: list[ViewScore]) -> str:
    return str(sum(view.metrics.frames for view in views))


def _cells(values: Mapping[str, float], names: list[str]) -> list[str]:
    digits = {"dB": 2, "1": 4}
    return ["-" if np.isnan(values[name]) else f"{values[name]:.{digits[_UNITS[name]]}f}" for name in names]


def _parts(score: PartScore) -> TextTable:
    header = ["parts of", "adjusted Rand index", "parts", "points"]
    counts = (str(score.true_parts), str(score.points))
    return TextTable(
        "Parts",
        header,
        [
            ["the scene", _number(score.ari), str(score.discovered), str(score.points)],
            ["k-means on positions", _number(score.ari_kmeans), *counts],
            ["one part", _number(score.ari_one_part), "1", str(score.points)],
        ],
    )


def _tracks(score: TrackScore, unit: str) -> TextTable:
    header = ["tracks of", f"EPE{f' ({unit})' if unit else ''}", "of the diameter", "points", "frames"]
    rows = [
        [name, _number(error), _percent(error, score.diameter), str(score.points), str(score.frames)]
        for name, error in (("the scene", score.epe), ("no motion", score.static))
    ]
    return TextTable("Surface tracks", header, rows)


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.4g}"


def _percent(error: float, diameter: float) -> str:
    share = float(divide(error, diameter))
    return "-" if np.isnan(share) else f"{100 * share:.2f} %"


def video_notes(report: VideoReport) -> list[str]:
    """What was compared and how, and what was left out."""
    lines = [f"Truth: {report.truth}.", *report.notes]
    if report.views:
        lines += _picture_notes(report)
    for name, score in report.learned.items():
        said = "; ".join(f"{key} {value}" for key, value in score.choices.items())
        lines.append(f"{LEARNED_TITLES[name]}: {said}.")
    lines += [f"{LEARNED_TITLES[name]} not computed: {reason}" for name, reason in report.missing.items()]
    if "parts" in report.scene:
        lines.append(
            f"Parts: each true surface point takes the part of its {PART_NEIGHBORS} nearest Gaussians (opacity >= {SOLID:g}, "
            f"weight opacity / distance) in the first frame; k-means is told the true number of parts; "
            f"{report.scene['parts'].unknown} points without a true part left out."
        )
    if "tracks" in report.scene:
        lines.append(
            f"Tracks: points of the first frame, carried by their {TRACK_NEIGHBORS} nearest Gaussians; mean over points and "
            f"later frames; diameter {_number(report.scene['tracks'].diameter)} {report.length_unit}".rstrip()
            + " (diagonal of the bounding box in the first frame)."
        )
    if report.intervals:
        lines += resampling_note(report.resampling, "views", len(view_values(report)[0]))
    for entry in report.left_out:
        shown = ", ".join(entry.names[:_NAMES_SHOWN]) + (", ..." if len(entry.names) > _NAMES_SHOWN else "")
        lines.append(f"Left out, {entry.reason}: {len(entry.names)} ({shown}).")
    return lines


def _picture_notes(report: VideoReport) -> list[str]:
    said, (width, height) = choices(report.protocol), report.size
    counts = f"{len(report.views)} view{'s' if len(report.views) > 1 else ''}, {_frames(report.views)} frames"
    lines = [
        f"{counts} of {width}x{height} pixels over {said['background']}, {said['colors']}, size: {said['size']}; "
        f"data range {said['data_range']}; means {said['mean']}.",
        *(f"{TITLES[name].removesuffix(' (dB)')}: {said[name]}." for name in report.names if name in PICTURE_METRICS),
    ]
    exact, empty = (sum(getattr(view.metrics, key) for view in report.views) for key in ("exact", "without_object"))
    if "psnr_foreground" in report.names:
        lines.append(f"A wide {said['background']} background raises PSNR and SSIM, but not PSNR on object.")
    if exact:
        lines.append(f"{exact} frames are equal and count as {PSNR_CAP:g} dB.")
    if empty and "psnr_foreground" in report.names:
        lines.append(f"{empty} frames without an object in the truth: left out of PSNR on object.")
    return lines


def video_json(report: VideoReport, source: str) -> dict[str, Any]:
    """One object for `--json`: numbers under `metrics`, None where a number is undefined."""
    metrics: dict[str, Any] = {}
    if report.views:
        metrics = _defined(report.mean()) | {
            "per_role": {role: _defined(means) for role, means in report.roles.items()},
            "per_view": [_view(view, report.names) for view in report.views],
        }
    metrics |= _defined({name: score.value for name, score in report.learned.items()})
    metrics |= {name: None for name in report.missing}
    units = {name: _UNITS.get(name, "1") for name in report.names if name in (*_UNITS, *LEARNED_TITLES)}
    pixels = report.size[0] * report.size[1] if not report.protocol.size else report.protocol.size**2
    denominators = {
        "views": len(report.views),
        "frames": sum(view.metrics.frames for view in report.views),
        "pixels": pixels if report.views else 0,
    }
    if report.learned:
        metrics["per_view_learned"] = {name: _defined(s.per_view) for name, s in report.learned.items() if s.per_view}
        metrics["of_the_truth"] = _defined({n: s.truth for n, s in report.learned.items() if s.truth is not None})
        denominators |= {name: score.counts for name, score in report.learned.items()}
    for name, score in report.scene.items():
        metrics[name] = _parts_json(score) if isinstance(score, PartScore) else _tracks_json(score)
        denominators[name] = {key: value for key, value in asdict(score).items() if isinstance(value, int)}
    if "tracks" in report.scene:
        units |= {
            "epe": report.length_unit,
            "epe_no_motion": report.length_unit,
            "epe_of_diameter": "fraction",
            "epe_no_motion_of_diameter": "fraction",
            "diameter": report.length_unit,
        }
    names = list(view_values(report)[0])
    return {
        "task": "video",
        "input": source,
        "protocol": choices(report.protocol)
        | {"truth": report.truth}
        | _scene_choices(report)
        | {name: score.choices for name, score in report.learned.items()},
        "metrics": metrics,
        "units": units | ({"adjusted_rand_index": "1"} if "parts" in report.scene else {}),
        "denominators": denominators,
        "samples": samples_json("views", names),
        "intervals": intervals_json(report.resampling, "views", len(names), report.intervals),
        "left_out": [{"reason": e.reason, "count": len(e.names), "names": e.names} for e in report.left_out],
        "not_computed": report.missing,
        "notes": report.notes,
        "provenance": report.history,
    }


def _scene_choices(report: VideoReport) -> dict[str, str]:
    said = {
        "parts": f"{PART_NEIGHBORS} nearest Gaussians of opacity >= {SOLID:g}, weight opacity / distance, first frame",
        "tracks": f"first frame's points carried by {TRACK_NEIGHBORS} nearest Gaussians, mean over points and later frames",
    }
    return {name: said[name] for name in report.scene}


def _view(view: ViewScore, names: tuple[str, ...]) -> dict[str, Any]:
    own = asdict(view.metrics)
    numbers = _defined({name: own[name] for name in names if name in PICTURE_METRICS})
    counts = ["frames", "pixels", "exact", *(["object_pixels", "without_object"] if "psnr_foreground" in names else [])]
    kept = {key: own[key] for key in counts} | {"worst_frame": own["worst"] if own["worst"] >= 0 else None}
    return {"view": view.title, "role": view.role, **numbers, **kept}


def _parts_json(score: PartScore) -> dict[str, Any]:
    return _defined(
        {
            "adjusted_rand_index": score.ari,
            "adjusted_rand_index_kmeans": score.ari_kmeans,
            "adjusted_rand_index_one_part": score.ari_one_part,
        }
    )


def _tracks_json(score: TrackScore) -> dict[str, Any]:
    shares = {
        f"{name}_of_diameter": float(divide(error, score.diameter))
        for name, error in (("epe", score.epe), ("epe_no_motion", score.static))
    }
    return _defined({"epe": score.epe, "epe_no_motion": score.static, **shares, "diameter": score.diameter})


def _defined(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: None if np.isnan(value) else float(value) for name, value in values.items()}
