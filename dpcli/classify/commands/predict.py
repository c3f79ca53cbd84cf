"""`dpc classify predict`: class scores of every video of a file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.confidence import Confidence, choose_confidence
from dpcli.classify.data.clips import LOOKS, ClipSource, OneVideo
from dpcli.classify.data.likeness import tell_long
from dpcli.classify.data.videos import check_classes, select_videos
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, find_model, load_model
from dpcli.classify.video_scores import VideoScores, score_video
from dpcli.counted import counted
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device, cpu_count
from dpcli.runtime.machines.once_per_process import OncePerProcess
from dpcli.runtime.machines.shards import describe_shard
from dpcli.runtime.machines.spread import ALONE, Spread
from dpcli.runtime.progress import log
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.store import CloudSequence, CloudsReader, ScoresReader, ScoresWriter, input_file, output_file
from dpcli.store.writing.already_made import WORK, already_made
from dpcli.store.writing.item_pass import ItemPass, Wording, skipped_lines

_WORTH_WORKERS = 500  # clips; fewer are scored by one process before a second has started


@dataclass(frozen=True)
class Prediction:
    """Says how many videos were scored in how many classes; `complete` where an earlier run had done it all."""

    videos: int
    classes: int
    complete: bool = False


@dataclass(frozen=True)
class ScoreVideo:
    """Scores one video; picklable, for worker processes."""

    model: OncePerProcess[tuple[Kinet, ModelInfo]]
    clips_per_video: int | None
    batch: int
    device: str
    streams: tuple[str, ...]
    seed: int

    def __call__(self, sequence: CloudSequence) -> VideoScores:
        """Returns the scores of a sequence."""
        model, info = self.model.get()
        source = ClipSource(OneVideo.of(sequence), [0], info.config, timing=info.timing, seed=self.seed)
        return score_video(model, source, 0, self.clips_per_video, self.batch, self.device, self.streams)


def predict(
    task: ModelTask,
    clips_per_video: int | None = None,
    drop_short: bool = False,
    batch: int = 8,
    spread: Spread = ALONE,
    reject_below: str | None = None,
) -> Prediction:
    """Scores the videos and writes a scores file; goes on where a stopped run ended.

    clips_per_video: spread evenly over a video, None takes every start. reject_below: see `choose_confidence`; None marks
    nothing as rejected. spread: who works on which videos. Raises UsageError when the output holds something else, DataError
    when data and model don't fit.
    """
    weights = find_model(task.model)
    open_model = partial(_open_model, weights.resolve(), task.backbone, task.device)  # workers may stand elsewhere
    model, info = open_model()
    with input_file(task.data) as path, output_file(task.output) as target:
        reader = CloudsReader(path)
        check_classes(reader, info, task.model)
        sequences = select_videos(reader, task.split, info, task.model)
        source = task.clips(reader, sequences, info, drop_short=drop_short)
        tell_long(reader, source.sequences, info, task.model)
        if info.timing == "slots" and (clips_per_video or 0) > LOOKS:
            log.info(
                f"--clips-per-video {clips_per_video}: {task.model} is for sparse clouds, whose clips are whole videos; {LOOKS}"
                " of each are taken, the most there are"
            )
        config = _record(task, info, source, clips_per_video)
        confidence = None if reject_below is None else choose_confidence(info.notes, reject_below, task.model)
        if confidence is not None:
            config["reject_below"] = {"temperature": confidence.temperature, "threshold": confidence.threshold}
        entry = describe_shard(provenance.record(config, task.seed, {"clouds": path}), spread.shard)
        complete = not task.force and already_made(target, entry, ScoresReader, WORK)
        if not complete:
            keep_freed_memory()
            with _writer(task, target, info, [*reader.provenance, entry], confidence is not None) as writer:
                once = OncePerProcess(open_model, config["weights"] + task.device, (model, info))
                device = str(choose_device(task.device))
                work = ScoreVideo(once, clips_per_video, batch, device, writer.streams, task.seed)
                split = task.split if task.split == "validation" else None
                _score_videos(source, work, writer, split, spread, confidence or Confidence())
        made = ScoresReader(target)
    if made.rejected is not None:
        log.info(
            f"nothing recognized in {int(made.rejected.sum())} of {counted(len(made.names), 'video')} (`rejected` in the file)"
        )
    for line in skipped_lines(made.skipped):
        log.warn(line)
    return Prediction(len(made.names), len(info.class_names), complete)


def _open_model(weights: Path, backbone: str | None, device: str) -> tuple[Kinet, ModelInfo]:
    chosen = choose_device(device)
    model, info = load_model(weights, backbone)
    return model.to(chosen), info


def _record(task: ModelTask, info: ModelInfo, source: ClipSource, clips_per_video: int | None) -> dict[str, Any]:
    """Returns what shapes the scores, for the file's provenance."""
    return {
        "split": task.split,
        "clips_per_video": clips_per_video,
        "drop_short": source.drop_short,
        "dropped": source.dropped,
        **task.model_record(info),
        "fusion": info.config.fusion,
    }


def _writer(task: ModelTask, target: Path, info: ModelInfo, history: list[dict], rejects: bool) -> ScoresWriter:
    return ScoresWriter(
        target,
        class_names=info.class_names,
        seed=task.seed,
        source=task.source,
        provenance=history,
        streams=info.streams,
        rejects=rejects,
        force=task.force,
        resume=task.output != "-",
    )


def _score_videos(
    source: ClipSource,
    work: ScoreVideo,
    writer: ScoresWriter,
    split: str | None,
    spread: Spread,
    confidence: Confidence,
) -> None:
    """Writes the scores of the videos that an earlier run has not scored. split: what to call the videos' split, None: as
    their file does."""
    reader, chosen = source.reader, source.sequences

    def load(place: int) -> CloudSequence:
        return reader.read(chosen[place], fields=source.config.column_fields)

    def write(place: int, video: VideoScores) -> dict[str, float]:
        i = chosen[place]
        label, own = int(reader.labels[i]), split or reader.splits[i]
        rejected = bool(confidence.of(video.fused).max() < confidence.threshold)
        writer.write(reader.names[i], video.fused, label=label, split=own, streams=video.streams, rejected=rejected)
        return {"clips": video.clips}

    names = [reader.names[i] for i in chosen]
    taken = ItemPass(writer, names, Wording("classify predict", "video", "scored"), spread.shard)
    with spread.workers(_worthwhile_processes(source, work)) as workers:
        taken.run(work, load, write, workers)


def _worthwhile_processes(source: ClipSource, work: ScoreVideo) -> int:
    """Returns how many processes are worthwhile: one for each core where the work takes longer than starting them, else one."""
    clips = accumulate(len(source.video_clips(sequence, work.clips_per_video)) for sequence in source.sequences)
    return cpu_count() if work.device == "cpu" and any(so_far > _WORTH_WORKERS for so_far in clips) else 1
