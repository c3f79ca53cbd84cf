"""`dpc classify predict` and `profile`, from options to files."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.videos import check_classes, report_short, select_videos
from dpcli.classify.network.kinet import STREAMS, Kinet
from dpcli.classify.network.model_file import find_model, load_model
from dpcli.classify.settings import network_config
from dpcli.classify.video_scores import predict_videos
from dpcli.errors import DataError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.store import CloudsReader, ScoresReader, ScoresWriter, input_file, output_file
from dpcli.store.writing.already_made import WORK, already_made

OTHER_SCORES = "holds scores of another model, data or choice; use another -o, or --force to replace it"


def run_prediction(
    data: str,
    model_name: str,
    output: str,
    *,
    split: str,
    clips_per_video: int | None,
    drop_short: bool,
    batch: int,
    seed: int,
    device: str,
    force: bool,
    backbone: str | None = None,
) -> None:
    """`dpc classify predict`."""
    chosen = choose_device(device)
    weights = find_model(model_name)
    model, info = load_model(weights, backbone)
    streams = tuple(info.notes.get("streams", STREAMS))
    with input_file(data) as path, output_file(output) as target:
        reader = CloudsReader(path)
        check_classes(reader, info, model_name)
        sequences = select_videos(reader, split, info, model_name)
        source = ClipSource(reader, sequences, info.config, timing=info.timing, drop_short=drop_short, seed=seed)
        report_short(source, info.config.num_frames)
        config = {
            "split": split,
            "clips_per_video": clips_per_video,
            "drop_short": drop_short,
            "dropped": source.dropped,
            "model": info.notes,
            "weights": provenance.file_digest(weights),
            "fusion": info.config.fusion,
        }
        history = [*reader.provenance, provenance.record(config, seed, {"clouds": path})]
        if not force and _already_scored(target, history[-1]):
            return
        keep_freed_memory()
        with ScoresWriter(
            target,
            class_names=info.class_names,
            seed=seed,
            source=reader.path.name if data != "-" else "stdin",
            provenance=history,
            streams=streams,
            force=force,
            resume=output != "-",
        ) as writer:
            try:
                _score(
                    model.to(chosen),
                    source,
                    writer,
                    streams,
                    clips_per_video,
                    batch,
                    chosen,
                    split if split == "validation" else None,
                )
            except Exception as error:
                writer.keep = not isinstance(error, DataError)  # too little memory says nothing about what was scored
                raise
    if output != "-":
        print(f"{output}: scores of {len(writer)} videos in {len(info.class_names)} classes")


def _already_scored(target: Path, entry: dict) -> bool:
    """Returns whether `target` holds the scores of this very work, and says so; UsageError when it holds something else."""
    if not already_made(target, entry, ScoresReader, OTHER_SCORES, WORK):
        return False
    log.info(f"{target}: already complete, made from the same model and data (--force makes it again)")
    print(f"{target}: complete")
    return True


def _score(
    model: Kinet,
    source: ClipSource,
    writer: ScoresWriter,
    streams: tuple[str, ...],
    count: int | None,
    batch: int,
    device: torch.device,
    split: str | None,
) -> None:
    """split: what to call the videos' split; None: as their file does."""
    reader, before = source.reader, set(writer.written_names)
    done = {i for i in source.sequences if reader.names[i] in before}
    if done:
        log.info(f"continuing: {len(done)} of {len(source.sequences)} videos were scored before")
    with stop_requested() as stop, Progress("classify predict", len(source.sequences), "video") as bar:
        bar.skip(len(done))
        for video in predict_videos(model, source, count, batch, device, streams, done):
            i = video.sequence
            writer.write(
                reader.names[i],
                video.fused,
                label=int(reader.labels[i]),
                split=split or reader.splits[i],
                streams=video.streams,
            )
            bar.advance(1, clips=video.clips)
            if writer.resume:
                stop.check(f"{len(writer)} of {len(source.sequences)} videos are kept")
            else:  # a pipe
                stop.check("nothing was kept", again="to start over")


def run_profile(
    model_name: str | None,
    *,
    preset: str,
    variant: str | None,
    classes: int,
    frames: int | None,
    points: int | None,
    steps: bool,
    device: str,
    json_output: bool,
    backbone: str | None = None,
) -> None:
    """`dpc classify profile`."""
    from dpcli.classify import cost as profile

    chosen = choose_device(device)
    if model_name:
        model = load_model(model_name, backbone)[0]
    else:
        model = Kinet(
            network_config(preset, variant, {"num_frames": frames, "points_per_frame": points}, classes, backbone)
        ).eval()
    result = profile.measure(model.to(chosen), chosen, steps)
    print(json.dumps(result) if json_output else profile.render(result), file=sys.stdout)
