"""The video report as tables and notes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from dpcli.counted import counted
from dpcli.evaluate.choices import PICTURE_METRICS, PICTURE_UNITS
from dpcli.evaluate.metric_titles import metric_title, title_of
from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.results import left_out_note
from dpcli.evaluate.text_tables import UNDEFINED, TextTable, four_digit_ends, four_digits, resampling_note
from dpcli.evaluate.video.comparison import VideoReport, view_values
from dpcli.evaluate.video.frame_pass import ViewScore
from dpcli.evaluate.video.learned.base import TITLES as LEARNED_TITLES
from dpcli.evaluate.video.learned.base import LearnedScore
from dpcli.evaluate.video.part_discovery import PART_NEIGHBORS, SOLID, TRACK_NEIGHBORS, PartScore, TrackScore
from dpcli.evaluate.video.picture_statistics import PSNR_CAP
from dpcli.evaluate.video.protocol import describe_protocol
from dpcli.evaluate.video.surface import CAMERAS, MOST_POINTS, SHARES, SurfaceScore


def video_tables(report: VideoReport) -> list[TextTable]:
    """Returns a row for each view, each role with more than one view, and all; then what was asked for of a scene."""
    made = [_picture_table(report)] if report.views else []
    if report.learned or report.missing:
        made.append(_learned_table(report))
    if report.intervals:
        made.append(_interval_table(report))
    if "parts" in report.scene:
        made.append(_part_table(report.scene["parts"]))
    if "tracks" in report.scene:
        made.append(_track_table(report.scene["tracks"], report.length_unit))
    if "surface" in report.scene:
        made.append(_surface_table(report))
    return made


def _picture_table(report: VideoReport) -> TextTable:
    names = [name for name in report.names if name in PICTURE_METRICS]
    header = ["view", "role", "frames", *(metric_title(name, PICTURE_UNITS[name]) for name in names), "worst frame"]
    rows = [
        [
            view.title,
            view.role,
            str(view.metrics.frames),
            *_cells(asdict(view.metrics), names),
            str(view.metrics.worst) if view.metrics.worst >= 0 else UNDEFINED,
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


def _learned_table(report: VideoReport) -> TextTable:
    header, rows = ["metric", "value", "the truth's own", "of"], []
    for name in (name for name in report.names if name in LEARNED_TITLES):
        if name in report.missing:
            rows.append([LEARNED_TITLES[name], UNDEFINED, "", "not computed"])
            continue
        score = report.learned[name]
        own = "" if score.truth is None else four_digits(score.truth)
        rows.append([LEARNED_TITLES[name], four_digits(score.value), own, _counts(score)])
    return TextTable(f"Learned and temporal metrics, protocol {report.protocol.name}", header, rows)


def _interval_table(report: VideoReport) -> TextTable:
    means = report.mean() | {name: score.value for name, score in report.learned.items()}
    titles = {name: metric_title(name, unit) for name, unit in PICTURE_UNITS.items()} | LEARNED_TITLES
    rows = [[titles[name], four_digits(means[name]), four_digit_ends(own)] for name, own in report.intervals.items()]
    return TextTable("All views", ["metric", "mean", report.resampling.title], rows)


def _counts(score: LearnedScore) -> str:
    return ", ".join(f"{count} {name}" for name, count in score.counts.items())


def _frames(views: list[ViewScore]) -> str:
    return str(sum(view.metrics.frames for view in views))


def _cells(values: Mapping[str, float], names: list[str]) -> list[str]:
    digits = {"dB": 2, "1": 4}
    return [
        UNDEFINED if np.isnan(values[name]) else f"{values[name]:.{digits[PICTURE_UNITS[name]]}f}" for name in names
    ]


def _part_table(score: PartScore) -> TextTable:
    header = ["parts of", "adjusted Rand index", "parts", "points"]
    counts = (str(score.true_parts), str(score.points))
    return TextTable(
        "Parts",
        header,
        [
            ["the scene", four_digits(score.ari), str(score.discovered), str(score.points)],
            ["k-means on positions", four_digits(score.ari_kmeans), *counts],
            ["one part", four_digits(score.ari_one_part), "1", str(score.points)],
        ],
    )


def _track_table(score: TrackScore, unit: str) -> TextTable:
    header = ["tracks of", f"EPE{f' ({unit})' if unit else ''}", "EPE / diameter", "points", "frames"]
    rows = [
        [name, four_digits(error), _percent(error, score.diameter), str(score.points), str(score.frames)]
        for name, error in (("the scene", score.epe), ("no motion", score.static))
    ]
    return TextTable("Surface tracks", header, rows)


def _surface_table(report: VideoReport) -> TextTable:
    score, unit = report.scene["surface"], report.length_unit
    ends = score.intervals(report.resampling)
    titles = {"chamfer": f"Chamfer distance{f' ({unit})' if unit else ''}", "chamfer_of_diameter": "Chamfer / diameter"}
    rows = [
        [titles.get(name, title_of(name)), four_digits(mean_defined(each)), four_digit_ends(ends[name]) if ends else ""]
        for name, each in score.values().items()
    ]
    return TextTable("Surface", ["metric", "mean", report.resampling.title], rows)


def _percent(error: float, diameter: float) -> str:
    share = float(divide(error, diameter))
    return UNDEFINED if np.isnan(share) else f"{100 * share:.2f} %"


def video_notes(report: VideoReport) -> list[str]:
    """Returns sentences on what was compared and how, and what was left out."""
    lines = [f"Truth: {report.truth}.", *report.notes]
    if report.views:
        lines += _picture_notes(report)
    for name, score in report.learned.items():
        choices = "; ".join(f"{key} {value}" for key, value in score.choices.items())
        lines.append(f"{LEARNED_TITLES[name]}: {choices}.")
    lines += [f"{LEARNED_TITLES[name]} not computed: {reason}" for name, reason in report.missing.items()]
    if "parts" in report.scene:
        lines.append(
            f"Parts: each true surface point takes the part of its {PART_NEIGHBORS} nearest Gaussians (opacity >= {SOLID:g}, "
            f"weight opacity / distance) in the first frame; k-means is given the true number of parts; "
            f"{report.scene['parts'].unknown} points without a true part left out."
        )
    if "tracks" in report.scene:
        lines.append(
            f"Tracks: points of the first frame, carried by their {TRACK_NEIGHBORS} nearest Gaussians; mean over points and "
            f"later frames; diameter {four_digits(report.scene['tracks'].diameter)} {report.length_unit}".rstrip()
            + " (diagonal of the bounding box in the first frame)."
        )
    if "surface" in report.scene:
        lines.append(_surface_note(report.scene["surface"]))
    if report.intervals:
        lines += resampling_note(report.resampling, "views", len(view_values(report)[0]))
    return [*lines, *(left_out_note(entry) for entry in report.left_out)]


def _surface_note(score: SurfaceScore) -> str:
    reach = " and ".join(f"{100 * share:g} %" for share in SHARES)
    unseen = (
        f" {counted(score.unseen, 'frame')} in which the scene shows nothing: F-score 0, no distance."
        if score.unseen
        else ""
    )
    return (
        f"Surface: what {CAMERAS} cameras around see of the scene (alpha of one half or more), at most {MOST_POINTS} points "
        f"a frame, against {score.points} true points; F-score within {reach} of the diameter {four_digits(score.diameter)}; "
        f"mean over {counted(len(score.chamfer), 'frame')}, which the intervals resample.{unseen}"
    )


def _picture_notes(report: VideoReport) -> list[str]:
    choices, (width, height) = describe_protocol(report.protocol), report.size
    counts = f"{counted(len(report.views), 'view')}, {counted(int(_frames(report.views)), 'frame')}"
    lines = [
        f"{counts} of {width}x{height} pixels over {choices['background']}, {choices['colors']}, size: {choices['size']}; "
        f"data range {choices['data_range']}; means {choices['mean']}.",
        *(f"{title_of(name)}: {choices[name]}." for name in report.names if name in PICTURE_METRICS),
    ]
    exact, empty = (sum(getattr(view.metrics, key) for view in report.views) for key in ("exact", "without_object"))
    if "psnr_foreground" in report.names:
        lines.append(f"A wide {choices['background']} background raises PSNR and SSIM, but not PSNR on object.")
    if exact:
        lines.append(f"{counted(exact, 'frame')} equal to the truth, counted as {PSNR_CAP:g} dB.")
    if empty and "psnr_foreground" in report.names:
        lines.append(f"{counted(empty, 'frame')} without an object in the truth: left out of PSNR on object.")
    return lines
