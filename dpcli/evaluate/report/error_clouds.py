"""Error clouds: the sequences a segmenter does worst and middling on, as points that a page can turn."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from dpcli.draw.palette import PALETTE, UNKNOWN
from dpcli.draw.sheet import spread_evenly
from dpcli.evaluate.proportions import mean_defined
from dpcli.evaluate.report.blocks import Figure, Table, cell, table, text_of
from dpcli.evaluate.report.charts import histogram
from dpcli.evaluate.segmentation.part_matching import hungarian_matching, mean_iou
from dpcli.evaluate.segmentation.part_overlap import overlap
from dpcli.evaluate.segmentation.rigid_motion import true_flow, true_motion
from dpcli.evaluate.segmentation.truth_pairing import PairedSequences, SequencePair

_WORST, _MEDIAN = 3, 2
_MOST_POINTS = 1500  # of a cloud on the page
_STEPS, _BYTE, _MOST_PARTS = 65535, 255, 254
_ROWS = 200  # sequences listed


@dataclass(frozen=True)
class SequenceError:
    """Holds one sequence: mIoU of each frame f64 (F), NaN where no part is true; end-point errors f64 (pairs), of means.

    place: among the paired sequences.
    """

    place: int
    name: str
    iou: np.ndarray
    epe: np.ndarray

    @property
    def mean(self) -> float:
        """Returns the mean over frames of the mIoU; NaN = undefined."""
        return mean_defined(self.iou)


@dataclass(frozen=True)
class Cloud:
    """Holds what is drawn of a frame: points f32 (N,3), true and predicted part i (N), error f64 (N) >= 0 (NaN = unknown).

    unit: of the end-point errors, None where an error of 1 is a wrong part.
    """

    points: np.ndarray
    truth: np.ndarray
    part: np.ndarray
    error: np.ndarray
    unit: str | None


def part_blocks(path: Path, truth: Path, *, split: str | None = None, motion: bool = False) -> list[Table | Figure]:
    """Returns how errors are spread over sequences, frames and pairs, the worst sequences by name, and clouds of some."""
    fields = ("part", "pose") if motion else ("part",)
    with PairedSequences(path, truth, split=split, fields=fields) as paired:
        errors = [_sequence_error(place, paired.pair(place), motion) for place in range(len(paired.rows))]
        known = [own for own in errors if not np.isnan(own.mean)]
        shown = _choose_sequences(known)
        unit = paired.truth.length_unit
        clouds = [(title, own, frame, _read_cloud(paired, own, frame)) for title, own, frame in shown]
    return [
        *_error_histograms(known, unit),
        _sequence_table(known, unit),
        *([_clouds_figure(clouds)] if clouds else []),
    ]


def _sequence_error(place: int, pair: SequencePair, motion: bool) -> SequenceError:
    ious = [mean_iou(pair.truth.part[span], pair.predicted.part[span]) for span in pair.spans]
    pairs = zip(pair.parts.pairs.tolist(), pair.parts.flow, strict=True) if motion else ()
    errors = [mean_defined(_flow_error(pair, *frames, flow)) for frames, flow in pairs]
    return SequenceError(place, pair.truth.name, np.array(ious), np.array(errors))


def _flow_error(pair: SequencePair, source: int, target: int, flow: np.ndarray) -> np.ndarray:
    """Returns the end-point error f64 (N) of the points of a frame, NaN without a true part."""
    truth, span = pair.truth, pair.span(source)
    points, part = truth.points[span], truth.part[span]
    real = true_flow(points, np.maximum(part, 0), true_motion(truth.pose, source, target))
    return np.where(part >= 0, np.linalg.norm(flow - real, axis=1), np.nan)


def _choose_sequences(errors: Sequence[SequenceError]) -> list[tuple[str, SequenceError, int]]:
    """Returns the worst sequences by mIoU and those in the middle, each with the frame nearest to its mean."""
    order = sorted(errors, key=lambda own: (own.mean, own.name))
    middle = max((len(order) - _MEDIAN) // 2, _WORST)
    picked = [("worst", own) for own in order[:_WORST]] + [("median", own) for own in order[middle : middle + _MEDIAN]]
    return [(title, own, int(np.nanargmin(np.abs(own.iou - own.mean)))) for title, own in picked]


def _read_cloud(paired: PairedSequences, own: SequenceError, frame: int) -> Cloud:
    """Returns a frame of a sequence, predicted parts renamed to the true ones they cover best; thinned evenly.

    Where poses are read and a pair begins at the frame, the error is that of its flow.
    """
    pair = paired.pair(own.place)
    truth, span, unit = pair.truth, pair.span(frame), None
    part = _rename_parts(truth.part[span], pair.predicted.part[span])
    error = np.where(truth.part[span] >= 0, (part != truth.part[span]).astype(np.float64), np.nan)
    from_frame = np.flatnonzero(pair.parts.pairs[:, 0] == frame)
    if "pose" in paired.fields and len(from_frame):
        row, unit = from_frame[0], paired.truth.length_unit
        error = _flow_error(pair, *pair.parts.pairs[row].tolist(), pair.parts.flow[row])
    keep = spread_evenly(len(error), _MOST_POINTS)
    return Cloud(truth.points[span][keep], truth.part[span][keep], part[keep], error[keep], unit)


def _rename_parts(truth: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Returns predicted ids i (N) as the true ids that overlap them most, one to one; the others come after all true ids."""
    found = overlap(truth, part)
    rows, columns = hungarian_matching(found.shared / found.union)
    free = int(max(truth.max(initial=0), 0)) + 1
    names = np.arange(free, free + len(found.ids))
    names[columns] = np.where(found.shared[rows, columns] > 0, found.truth_ids[rows], names[columns])
    return np.where(found.columns >= 0, names[np.maximum(found.columns, 0)] if len(names) else -1, -1)


def _error_histograms(errors: Sequence[SequenceError], unit: str) -> list[Figure]:
    if not errors:
        return []
    made = [Figure("mIoU of the sequences", histogram([own.mean for own in errors], "fraction"))]
    frames = np.concatenate([own.iou for own in errors])
    if len(frames) > len(errors):
        made.append(Figure("mIoU of the frames", histogram(frames[~np.isnan(frames)], "fraction")))
    pairs = np.concatenate([own.epe for own in errors])
    if len(pairs):
        words = f" ({unit})" if unit else ""
        made.append(Figure(f"End-point error of the frame pairs{words}", histogram(pairs[~np.isnan(pairs)])))
    return made


def _sequence_table(errors: Sequence[SequenceError], unit: str) -> Table:
    order = sorted(errors, key=lambda own: (own.mean, own.name))[:_ROWS]
    motion = any(len(own.epe) for own in errors)
    rows = [
        [
            own.name,
            cell(len(own.iou)),
            cell(own.mean, "fraction", bar=True),
            cell(float(np.nanmin(own.iou)), "fraction"),
            *([cell(mean_defined(own.epe)) if len(own.epe) else "-"] if motion else []),
        ]
        for own in order
    ]
    header = [
        "sequence",
        "frames",
        "mIoU",
        "mIoU of its worst frame",
        *([f"EPE3D ({unit})".replace(" ()", "")] if motion else []),
    ]
    note = "Worst first" + (f"; the {_ROWS} worst of {len(errors)}." if len(errors) > _ROWS else ".")
    return table("By sequence", header, rows, note, key="per_sequence")


def _clouds_figure(clouds: list[tuple[str, SequenceError, int, Cloud]]) -> Figure:
    html = "".join(_markup(*own) for own in clouds)
    note = (
        "Truth, prediction and error of the worst sequences by mIoU and of those in the middle, each at the frame nearest to its "
        "mean; predicted parts have the color of the true part they cover best. Drag or use the arrow keys to turn."
    )
    return Figure("Error clouds", f'<div class="clouds">{html}</div>', note)


def _markup(title: str, own: SequenceError, frame: int, cloud: Cloud) -> str:
    top = float(np.nanmax(cloud.error)) if np.isfinite(cloud.error).any() else 0.0
    motion = cloud.unit is not None
    words = f"red: end-point error up to {text_of(top)} {cloud.unit}".rstrip() if motion else "red: wrong part"
    caption = f"{title}: {own.name}, frame {frame}, mIoU {text_of(float(own.iou[frame]), 'fraction')}"
    data = base64.b64encode(pack_cloud(cloud)).decode("ascii")
    return (
        f'<figure class="cloud" data-points="{len(cloud.points)}" data-cloud="{data}">'
        f"<figcaption>{escape(caption)} <span class=faint>{len(cloud.points)} points shown; {escape(words)}</span></figcaption>"
        f'<canvas tabindex="0" role="img" aria-label="{escape(caption)}: truth, prediction, error"></canvas></figure>'
    )


def pack_cloud(cloud: Cloud) -> bytes:
    """Returns a cloud as bytes for the page, little endian.

    u16 x, y, z (3N) in a cube around the points, then u8 truth + 1, part + 1 (2N, 0 = none), u8 error (N, share of the
    largest).
    """
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    side = max(float((high - low).max()), 1e-9)
    steps = np.rint(((cloud.points - (low + high) / 2) / side + 0.5) * _STEPS).clip(0, _STEPS)
    parts = [np.clip(ids, -1, _MOST_PARTS) + 1 for ids in (cloud.truth, cloud.part)]
    error = np.nan_to_num(cloud.error)
    shares = np.rint(error / max(float(error.max(initial=0)), 1e-12) * _BYTE)
    return steps.T.astype("<u2").tobytes() + b"".join(own.astype(np.uint8).tobytes() for own in (*parts, shares))


def palette_words() -> str:
    """Returns the colors of unknown points and of the parts, for the page's script."""
    return " ".join(f"{r},{g},{b}" for r, g, b in [UNKNOWN, *PALETTE.tolist()])
