"""`dpc classify predict`: class scores of every video of a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.commands.scores_made import already_scored
from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.videos import check_classes, report_short, select_videos
from dpcli.classify.network.kinet import STREAMS
from dpcli.classify.network.model_file import ModelInfo, find_model, load_model
from dpcli.classify.video_scores import VideoScores, predict_videos
from dpcli.errors import DataError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.store import CloudsReader, ScoresWriter, input_file, output_file


@dataclass(frozen=True)
class Prediction:
    """Says how many videos were scored in how many classes; `complete` where an earlier run had done it all."""

    videos: int
    classes: int
    complete: bool = False


def predict(
    task: ModelTask, clips_per_video: int | None = None, drop_short: bool = False, batch: int = 8
) -> Prediction:
    """Scores the videos and writes a scores file; goes on where a stopped run ended.

    clips_per_video: spread evenly over a video, None takes every start. Raises UsageError when the output holds something
    else, DataError when data and model don't fit.
    """
    device = choose_device(task.device)
    weights = find_model(task.model)
    model, info = load_model(weights, task.backbone)
    with input_file(task.data) as path, output_file(task.output) as target:
        reader = CloudsReader(path)
        check_classes(reader, info, task.model)
        sequences = select_videos(reader, task.split, info, task.model)
        source = ClipSource(reader, sequences, info.config, timing=info.timing, drop_short=drop_short, seed=task.seed)
        report_short(source, info.config.num_frames)
        config = _record(task, weights, info, source, clips_per_video)
        history = [*reader.provenance, provenance.record(config, task.seed, {"clouds": path})]
        if not task.force and already_scored(target, history[-1]):
            return Prediction(len(source.sequences), len(info.class_names), complete=True)
        keep_freed_memory()
        with _writer(task, target, info, history) as writer:
            done = _done(source, writer)
            videos = predict_videos(model.to(device), source, clips_per_video, batch, device, writer.streams, done)
            _write(videos, source, writer, len(done), task.split if task.split == "validation" else None)
    return Prediction(len(writer), len(info.class_names))


def _record(
    task: ModelTask, weights: Path, info: ModelInfo, source: ClipSource, clips_per_video: int | None
) -> dict[str, Any]:
    """Returns what shapes the scores, for the file's provenance."""
    return {
        "split": task.split,
        "clips_per_video": clips_per_video,
        "drop_short": source.drop_short,
        "dropped": source.dropped,
        "model": info.notes,
        "weights": provenance.file_digest(weights),
        "fusion": info.config.fusion,
    }


@contextmanager
def _writer(task: ModelTask, target: Path, info: ModelInfo, history: list[dict]) -> Iterator[ScoresWriter]:
    """Opens the scores file. What was scored is kept for the next run when this one fails, unless the data are bad: too
    little memory says nothing about what was scored."""
    with ScoresWriter(
        target,
        class_names=info.class_names,
        seed=task.seed,
        source=task.source,
        provenance=history,
        streams=tuple(info.notes.get("streams", STREAMS)),
        force=task.force,
        resume=task.output != "-",
    ) as writer:
        try:
            yield writer
        except Exception as error:
            writer.keep = not isinstance(error, DataError)
            raise


def _done(source: ClipSource, writer: ScoresWriter) -> set[int]:
    """Returns the sequences that an earlier run has scored."""
    before = set(writer.written_names)
    done = {i for i in source.sequences if source.reader.names[i] in before}
    if done:
        log.info(f"continuing: {len(done)} of {len(source.sequences)} videos were scored before")
    return done


def _write(
    videos: Iterator[VideoScores], source: ClipSource, writer: ScoresWriter, done: int, split: str | None
) -> None:
    """Writes the scores as they come. done: videos scored before; split: what to call the videos' split, None: as their
    file does."""
    reader, total = source.reader, len(source.sequences)
    with stop_requested() as stop, Progress("classify predict", total, "video") as bar:
        bar.skip(done)
        for video in videos:
            i = video.sequence
            label, own = int(reader.labels[i]), split or reader.splits[i]
            writer.write(reader.names[i], video.fused, label=label, split=own, streams=video.streams)
            bar.advance(1, clips=video.clips)
            if writer.resume:
                stop.check(f"{len(writer)} of {total} videos are kept")
            else:  # a pipe
                stop.check("nothing was kept", again="to start over")
