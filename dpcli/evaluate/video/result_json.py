"""The video report as the object that `--json` prints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from dpcli.evaluate.choices import PICTURE_METRICS, PICTURE_UNITS
from dpcli.evaluate.proportions import divide, mean_defined
from dpcli.evaluate.results import intervals_json, left_out_json, none_if_nan, samples_json
from dpcli.evaluate.video.comparison import VideoReport, view_values
from dpcli.evaluate.video.frame_pass import ViewScore
from dpcli.evaluate.video.learned.base import TITLES as LEARNED_TITLES
from dpcli.evaluate.video.part_discovery import PART_NEIGHBORS, SOLID, TRACK_NEIGHBORS, PartScore, TrackScore
from dpcli.evaluate.video.protocol import describe_protocol
from dpcli.evaluate.video.surface import CAMERAS, MOST_POINTS, SurfaceScore


def video_json(report: VideoReport, source: str) -> dict[str, Any]:
    """Returns the report with its numbers under `metrics`, None where a number is undefined.

    source: the predicted video, as it was named.
    """
    names = list(view_values(report)[0])
    return {
        "task": "video",
        "input": source,
        "protocol": describe_protocol(report.protocol)
        | {"truth": report.truth}
        | _scene_choices(report)
        | {name: score.choices for name, score in report.learned.items()},
        "metrics": _metrics(report),
        "units": _units(report),
        "denominators": _denominators(report),
        "samples": samples_json("views", names),
        "intervals": intervals_json(report.resampling, "views", len(names), report.intervals),
        **_surface_intervals(report),
        "left_out": left_out_json(report.left_out),
        "not_computed": report.missing,
        "notes": report.notes,
        "provenance": report.provenance,
    }


def _metrics(report: VideoReport) -> dict[str, Any]:
    metrics: dict[str, Any] = {}
    if report.views:
        metrics = _defined(report.mean()) | {
            "per_role": {role: _defined(means) for role, means in report.roles.items()},
            "per_view": [_view(view, report.names) for view in report.views],
        }
    learned = report.learned
    metrics |= _defined({name: score.value for name, score in learned.items()})
    metrics |= {name: None for name in report.missing}
    if learned:
        metrics["per_view_learned"] = {name: _defined(s.per_view) for name, s in learned.items() if s.per_view}
        metrics["of_the_truth"] = _defined({n: s.truth for n, s in learned.items() if s.truth is not None})
    for name, score in report.scene.items():
        metrics[name] = _SCENE_JSON[name](score)
    return metrics


def _surface_intervals(report: VideoReport) -> dict[str, Any]:
    """Returns the intervals of the surface's means under a name of their own: frames are resampled there, not views."""
    if "surface" not in report.scene:
        return {}
    score = report.scene["surface"]
    ends = score.intervals(report.resampling)
    return {"surface_intervals": intervals_json(report.resampling, "frames", len(score.chamfer), ends)}


def _units(report: VideoReport) -> dict[str, str]:
    units = {name: PICTURE_UNITS.get(name, "1") for name in report.names if name in (*PICTURE_UNITS, *LEARNED_TITLES)}
    if "surface" in report.scene:
        shares = dict.fromkeys(report.scene["surface"].values(), "fraction")
        units |= shares | {"chamfer": report.length_unit, "diameter": report.length_unit}
    if "tracks" in report.scene:
        units |= {
            "epe": report.length_unit,
            "epe_no_motion": report.length_unit,
            "epe_of_diameter": "fraction",
            "epe_no_motion_of_diameter": "fraction",
            "diameter": report.length_unit,
        }
    return units | ({"adjusted_rand_index": "1"} if "parts" in report.scene else {})


def _denominators(report: VideoReport) -> dict[str, Any]:
    pixels = report.size[0] * report.size[1] if not report.protocol.size else report.protocol.size**2
    counts: dict[str, Any] = {
        "views": len(report.views),
        "frames": sum(view.metrics.frames for view in report.views),
        "pixels": pixels if report.views else 0,
    }
    counts |= {name: score.counts for name, score in report.learned.items()}
    for name, score in report.scene.items():
        counts[name] = {key: value for key, value in asdict(score).items() if isinstance(value, int)}
    if "surface" in report.scene:
        counts["surface"]["frames"] = len(report.scene["surface"].chamfer)
    return counts


def _scene_choices(report: VideoReport) -> dict[str, str]:
    words = {
        "parts": f"{PART_NEIGHBORS} nearest Gaussians of opacity >= {SOLID:g}, weight opacity / distance, first frame",
        "tracks": f"first frame's points carried by {TRACK_NEIGHBORS} nearest Gaussians, mean over points and later frames",
        "surface": f"{CAMERAS} cameras around, alpha of one half or more, at most {MOST_POINTS} points a frame",
    }
    return {name: words[name] for name in report.scene}


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


def _surface_json(score: SurfaceScore) -> dict[str, Any]:
    means = {name: mean_defined(each) for name, each in score.values().items()}
    return _defined(means | {"diameter": score.diameter})


_SCENE_JSON = {"parts": _parts_json, "tracks": _tracks_json, "surface": _surface_json}


def _defined(values: Mapping[str, float]) -> dict[str, float | None]:
    return {name: none_if_nan(value) for name, value in values.items()}
