"""What `dpc classify explain` does, from options to files."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.videos import check_classes, report_short, select_videos
from dpcli.classify.explain.pictures import ANIMATIONS, activation_animation, activation_sheet, plane_picture
from dpcli.classify.explain.point_activation_cloud import ActivationCloud, Question, activation_cloud
from dpcli.classify.explain.tsne import (
    NEIGHBORS,
    chosen_perplexity,
    joined,
    neighbor_accuracy,
    plane,
    silhouette,
    video_features,
)
from dpcli.classify.network.kinet import STREAMS
from dpcli.classify.network.model_file import ModelInfo, find_model, load_model
from dpcli.draw.view import default_view, parse_view
from dpcli.errors import DataError, UsageError
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.runtime.whole_file import FIGURES, PICTURES, check_target
from dpcli.store import CloudsReader, CloudsWriter, input_file, output_file
from dpcli.store.embedding import StreamEmbedding, write_embedding


def run_pac(
    data: str,
    model_name: str,
    output: str,
    *,
    picture: Path | None,
    animation: Path | None,
    samples: str,
    split: str,
    stream: str | None,
    rule: str,
    target: str | None,
    stage: int | None,
    frames: int,
    view: str | None,
    seed: int,
    device: str,
    force: bool,
    backbone: str | None = None,
) -> None:
    """`dpc classify explain pac`."""
    if target is not None and rule == "activation":
        raise UsageError("--class: the rule activation (thesis A.1.4) knows no class; add --rule gradient")
    _check_targets(output, force, (picture, "--picture", PICTURES), (animation, "--animation", ANIMATIONS))
    chosen = choose_device(device)
    weights = find_model(model_name)
    model, info = load_model(weights, backbone)
    streams = _streams(stream, info)
    question = Question(rule, None if stage is None else stage - 1, _target(target, info.class_names))
    with input_file(data) as path, output_file(output) as place:
        reader = CloudsReader(path)
        check_classes(reader, info, model_name)
        axes = parse_view(view or default_view(reader.length_unit))
        sequences = chosen_samples(reader, samples, _pool(reader, samples, split, info, model_name))
        source = ClipSource(reader, sequences, info.config, timing=info.timing, seed=seed)
        report_short(source, info.config.num_frames)
        config = {
            "streams": list(streams),
            "rule": rule,
            "class": target,
            "stage": stage,
            "samples": samples,
            "split": split,
            "weights": provenance.file_digest(weights),
            "model": info.notes,
        }
        history = [*reader.provenance, provenance.record(config, seed, {"clouds": path})]
        clouds, clips = [], source.clips(1)
        model.to(chosen)
        with stop_requested() as stop, Progress("explain pac", len(clips), "video") as bar:
            for clip in clips:
                clouds.append(activation_cloud(model, source, clip, streams, question, chosen))
                bar.advance(1)
                stop.check("nothing was kept", again="to start over")
        write_clouds(
            place,
            clouds,
            class_names=info.class_names,
            length_unit=reader.length_unit,
            seed=seed,
            rule=rule,
            source=_source(data),
            provenance=history,
            force=force,
        )
        if picture:
            activation_sheet(picture, clouds, info.class_names, axes, frames)
        if animation:
            activation_animation(animation, clouds, info.class_names, axes)
    if output != "-":
        print(
            f"{output}: activations of {sum(len(c.sequence.points) for c in clouds):,} points in {len(clouds)} clips of "
            f"{info.config.num_frames} frames"
        )


def _target(wanted: str | None, class_names: list[str]) -> str | int:
    """predicted, label, or the number of a class given by name or number."""
    if wanted is None or wanted in ("predicted", "label"):
        return wanted or "predicted"
    if wanted in class_names:
        return class_names.index(wanted)
    if wanted.isdigit() and int(wanted) < len(class_names):
        return int(wanted)
    raise UsageError(f"--class {wanted}: the model knows {', '.join(class_names)}; or say predicted or label")


def _pool(reader: CloudsReader, samples: str, split: str, info: ModelInfo, model_name: str) -> list[int]:
    counted = _is_count(reader, samples)
    return select_videos(reader, split, info, model_name) if counted else list(range(len(reader)))


def _is_count(reader: CloudsReader, samples: str) -> bool:
    return samples.isdigit() and samples not in reader.names


def chosen_samples(reader: CloudsReader, wanted: str, pool: Sequence[int]) -> list[int]:
    """Sequences named in `wanted` (separated by commas) in that order, or so many of the pool: the first of each class,
    of evenly chosen classes where there are more, then the second of each, and so on."""
    if not _is_count(reader, wanted):
        names = [name for name in wanted.split(",") if name]
        missing = sorted(set(names) - set(reader.names))
        if missing or not names:
            raise DataError(
                f"{reader.path}: no sample {', '.join(missing)!r}; it has {', '.join(reader.names[:3])}, ..."
            )
        return [reader.names.index(name) for name in dict.fromkeys(names)]
    count = int(wanted)
    if count < 1:
        raise UsageError(f"--samples {wanted}: expected 1 or more, or names")
    members: dict[int, list[int]] = defaultdict(list)
    for index in pool:
        members[int(reader.labels[index])].append(index)
    classes = sorted(members)
    if count < len(classes):
        return [members[classes[i]][0] for i in np.linspace(0, len(classes) - 1, count).round().astype(int)]
    turns = sorted((turn, label, index) for label in classes for turn, index in enumerate(members[label]))
    return [index for _, _, index in sorted(turns[:count], key=lambda item: item[1:])]


class _Writer(CloudsWriter):
    """A CloudsWriter with `more`: data sets written before the index, when all samples are there."""

    more: dict[str, np.ndarray] = {}

    def _complete(self) -> None:
        for name, values in self.more.items():
            self._file.create_dataset(name, data=values, compression="gzip", compression_opts=4, shuffle=True)
        super()._complete()


def write_clouds(path: Path, clouds: Sequence[ActivationCloud], *, rule: str, **options: Any) -> None:
    """A `clouds` file with the clips' frames and, beside the usual fields, `activation/STREAM` f32 (P) in 0..1, `frame`
    i32 (F) the frames' numbers in their videos, `explained` and `predicted` i32 (S) classes; root attribute
    `activation_rule`. Options as CloudsWriter's. UsageError when the file exists and `force` is off."""
    fields = [key for key in ("time", "color", "part", "track", "pose") if getattr(clouds[0].sequence, key) is not None]
    with _Writer(path, fields=fields, **options) as writer:
        for cloud in clouds:
            writer.write(cloud.sequence)
        writer._file.attrs["activation_rule"] = rule
        writer.more = {
            **{f"activation/{s}": np.concatenate([c.activation[s] for c in clouds]) for s in clouds[0].activation},
            "frame": np.concatenate([c.frames for c in clouds]).astype(np.int32),
            "explained": np.array([c.target for c in clouds], np.int32),
            "predicted": np.array([c.predicted for c in clouds], np.int32),
        }


def run_tsne(
    data: str,
    model_name: str,
    output: str,
    *,
    picture: Path | None,
    stream: str | None,
    split: str,
    perplexity: float | None,
    clips_per_video: int | None,
    batch: int,
    seed: int,
    device: str,
    force: bool,
    json_output: bool,
    backbone: str | None = None,
) -> None:
    """`dpc classify explain tsne`."""
    _check_targets(output, force, (picture, "--picture", FIGURES))
    chosen = choose_device(device)
    weights = find_model(model_name)
    model, info = load_model(weights, backbone)
    streams = _streams(stream, info)
    with input_file(data) as path, output_file(output) as place:
        reader = CloudsReader(path)
        check_classes(reader, info, model_name)
        sequences = select_videos(reader, split, info, model_name)
        source = ClipSource(reader, sequences, info.config, timing=info.timing, seed=seed)
        kept = source.sequences
        width = chosen_perplexity(perplexity, len(kept))
        report_short(source, info.config.num_frames)
        keep_freed_memory()
        features = video_features(model.to(chosen), source, clips_per_video, batch, chosen)
        if "fused" in streams:
            features["fused"] = joined(features)
        labels = reader.labels[kept]
        _remark(labels)
        said = {s: _embedding(features[s], labels, width, seed) for s in streams}
        config = {
            "streams": list(streams),
            "split": split,
            "perplexity": width,
            "clips_per_video": clips_per_video,
            "weights": provenance.file_digest(weights),
            "model": info.notes,
        }
        history = [*reader.provenance, provenance.record(config, seed, {"clouds": path})]
        write_embedding(
            place,
            [reader.names[i] for i in kept],
            labels,
            [reader.splits[i] for i in kept],
            said,
            class_names=info.class_names,
            source=_source(data),
            seed=seed,
            provenance=history,
            force=force,
        )
        if picture:
            captions = {s: _caption(said[s]) for s in streams}
            coordinates = {s: said[s].coordinates for s in streams}
            plane_picture(picture, coordinates, labels, info.class_names, captions)
    if json_output and output != "-":
        print(json.dumps(_report(said, labels, width)))
    else:
        show = log.info if output == "-" else print
        show(f"{len(labels)} videos, perplexity {width:g}; of the features, not of the map:")
        for s in streams:
            show(f"{s:<8} {said[s].features.shape[1]:>5} numbers, {_caption(said[s])}")


def _embedding(features: np.ndarray, labels: np.ndarray, perplexity: float, seed: int) -> StreamEmbedding:
    figures = {"neighbor_accuracy": neighbor_accuracy(features, labels), "silhouette": silhouette(features, labels)}
    values = {"perplexity": perplexity, **{key: value for key, value in figures.items() if value is not None}}
    return StreamEmbedding(features, plane(features, perplexity, seed), values)


def _remark(labels: np.ndarray) -> None:
    """What the figures can't say, and why."""
    unknown, classes = int((labels < 0).sum()), len(np.unique(labels[labels >= 0]))
    if unknown:
        log.info(f"{unknown} of {len(labels)} videos have no label: gray in the picture, left out of the figures")
    if classes < 2:
        log.info(
            f"{'one class' if classes else 'no labels'}: no neighbors' accuracy and no silhouette, which compare classes"
        )


def _caption(said: StreamEmbedding) -> str:
    accuracy, value = said.values.get("neighbor_accuracy"), said.values.get("silhouette")
    first = f"{NEIGHBORS} nearest neighbors {'-' if accuracy is None else f'{100 * accuracy:.1f} %'}"
    return f"{first}, silhouette {'-' if value is None else f'{value:.3f}'}"


def _report(said: dict[str, StreamEmbedding], labels: np.ndarray, perplexity: float) -> dict[str, Any]:
    metrics = {
        f"{s}_{key}": one.values.get(key) for s, one in said.items() for key in ("neighbor_accuracy", "silhouette")
    }
    units = {key: "-1..1" if key.endswith("silhouette") else "fraction" for key in metrics}
    return {
        "metrics": metrics,
        "units": units,
        "videos": len(labels),
        "labeled": int((labels >= 0).sum()),
        "neighbors": NEIGHBORS,
        "perplexity": perplexity,
    }


def _streams(text: str | None, info: ModelInfo) -> tuple[str, ...]:
    """The streams asked for, each once; without a word those that were trained. UsageError on others."""
    trained = tuple(info.notes.get("streams", STREAMS))
    known = (*trained, "fused") if len(trained) > 1 else trained
    wanted = trained if text is None else tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    if not wanted or not set(wanted) <= set(known):
        raise UsageError(f"--stream {text}: this model has {', '.join(known)}; name one or more, with commas between")
    return wanted


def _check_targets(output: str, force: bool, *pictures: tuple[Path | None, str, Sequence[str]]) -> None:
    """Everything that would fail after the work, said before it."""
    for path, option, kinds in pictures:
        if path is not None:
            check_target(path, option, kinds)
    if output != "-" and Path(output).exists() and not force:
        raise UsageError(f"{output}: exists already; --force replaces it")


def _source(data: str) -> str:
    return "stdin" if data == "-" else Path(data).name
