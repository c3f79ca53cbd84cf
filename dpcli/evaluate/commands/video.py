"""`dpc evaluate video`: compares a video or a Gaussian scene with the true video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dpcli.evaluate.bootstrap import Resampling
from dpcli.evaluate.choices import BACKGROUNDS, LEARNED_METRICS
from dpcli.evaluate.results import Result
from dpcli.evaluate.video.comparison import evaluate_video
from dpcli.evaluate.video.difference_strip import DifferenceStrip
from dpcli.evaluate.video.protocol import VideoProtocol, check_picture_of
from dpcli.evaluate.video.result_json import video_json
from dpcli.evaluate.video.tables import video_notes, video_tables
from dpcli.store import input_file


def run_video(
    predicted: str,
    truth: Path,
    *,
    metrics: Sequence[str] | None,
    protocol: VideoProtocol,
    intersect: bool,
    weights: Path | None,
    device: str,
    resampling: Resampling,
    picture: Path | None = None,
) -> Result:
    """Returns the metrics of a video (`-`: a views or gaussians file from a pipe); a strip of pictures goes to `picture`.

    The result is incomplete where a metric's network is absent. The other arguments and errors are those of
    `evaluate_video`; the seed of k-means is that of the resampling.
    """
    check_picture_of(metrics, picture)
    strip = DifferenceStrip(BACKGROUNDS[protocol.background]) if picture is not None else None
    with input_file(predicted) as path:
        report = evaluate_video(
            path,
            truth,
            metrics=metrics,
            protocol=protocol,
            intersect=intersect,
            seed=resampling.seed,
            watch=strip,
            weights=weights,
            device=_device_of(metrics, device),
            resampling=resampling,
        )
    if strip is not None:
        strip.save(picture)
    data = video_json(report, predicted)
    return Result(data, video_tables(report), video_notes(report), _missing_in_words(report.missing))


def _missing_in_words(missing: dict[str, str]) -> str:
    if not missing:
        return ""
    name, reason = next(iter(missing.items()))
    more = f" ({', '.join(list(missing)[1:])} neither)" if len(missing) > 1 else ""
    return f"{name} not computed{more}: {reason}"


def _device_of(metrics: Sequence[str] | None, device: str) -> str:
    """Returns the device that networks run on; torch is loaded only where there are some."""
    if not set(metrics or ()) & set(LEARNED_METRICS) - {"warping"}:
        return "cpu"
    from dpcli.runtime.device import choose_device

    return str(choose_device(device))
