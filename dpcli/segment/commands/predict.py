"""`dpc segment predict`: the parts of every sequence of a file, and their motions, as a file of kind `parts`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import UsageError
from dpcli.path_names import file_names, first_names
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.machines.once_per_process import OncePerProcess
from dpcli.runtime.machines.shards import describe_shard
from dpcli.runtime.machines.spread import ALONE, Spread
from dpcli.runtime.mixed_precision import wanted
from dpcli.runtime.progress import log
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.runtime.whole_file import PICTURES, check_target
from dpcli.segment.baselines.settings import ClassicalSettings
from dpcli.segment.flow.estimators import estimate_flow_both_ways, find_estimator
from dpcli.segment.multibody.segmenter import MultibodySegmenter
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.network.model_file import default_model
from dpcli.segment.prediction import pairs_to_report, predict_parts
from dpcli.segment.prediction_settings import PredictSettings, Refinement
from dpcli.segment.scene.segmenter import SceneSegmenter
from dpcli.segment.segmenters import ClassicalSegmenter, NetworkSegmenter, Segmenter
from dpcli.segment.sequence_splits import sequences_of_split
from dpcli.segment.thinning import spread_places
from dpcli.store import CloudSequence, CloudsReader, input_file, output_file
from dpcli.store.parts import PartsReader, PartsSample, PartsWriter
from dpcli.store.schema import taken_for_meters
from dpcli.store.sequence import OF_PARTS
from dpcli.store.writing.already_made import WORK, already_made
from dpcli.store.writing.item_pass import ItemPass, Wording, skipped_lines

_ROWS = 8  # sequences in a picture
_FLOW_BYTES, _MOTION_BYTES = 12, 64  # of a point's flow, of a part's motion, between two frames
_MUCH = 10**9  # bytes for one sequence: far more than a sequence itself takes


@dataclass(frozen=True)
class Drawings:
    """Holds where the parts are drawn, each None where it is not wanted: a sheet, a turning object, a folder of .ply."""

    picture: Path | None = None
    turntable: Path | None = None
    ply: Path | None = None

    def check(self) -> None:
        """Raises UsageError or DataError, before the work, for files that can't be written."""
        for path, option, kinds in ((self.picture, "--picture", PICTURES), (self.turntable, "--turntable", (".gif",))):
            if path is not None:
                check_target(path, option, kinds)


@dataclass(frozen=True)
class PartsOfSequence:
    """Finds the parts of one sequence; picklable, for worker processes. device: where a trained estimator of flow runs."""

    segmenter: OncePerProcess[Segmenter]
    flow: str
    device: str
    refinement: Refinement
    seed: int
    length_unit: str

    def __call__(self, sequence: CloudSequence) -> tuple[CloudSequence, PartsSample]:
        """Returns a sequence with its parts, and what else is said of it."""
        segmenter = self.segmenter.get()
        estimate = partial(estimate_flow_both_ways, method=self.flow, device=self.device)
        if isinstance(segmenter, SceneSegmenter):
            pairs = pairs_to_report(sequence.num_frames, self.refinement.pairs)
            labels, sample = segmenter.explain(sequence, pairs, self.length_unit)
        else:
            labels, sample = predict_parts(sequence, segmenter, estimate, self.refinement, self.seed)
        sequence.part = labels
        return sequence, sample


def predict_file(
    data: str,
    output: str,
    settings: PredictSettings,
    *,
    model: str | None,
    drawings: Drawings,
    seed: int,
    device: str,
    force: bool,
    spread: Spread = ALONE,
) -> int:
    """Writes the parts of a clouds file and draws them; returns the number of sequences.

    model: a trained network, None for the shipped one. spread: who works on which sequences. Running again continues
    where a stopped run ended.
    """
    drawings.check()
    segmenter = _open_segmenter(settings, model, device, seed)
    place = model and str(Path(model).resolve() if Path(model).exists() else model)  # workers may stand elsewhere
    open_segmenter = partial(_open_segmenter, settings, place, device, seed)
    refinement = replace(settings.refinement, smallest=settings.classical.least_share(settings.refinement.smallest))
    if not isinstance(segmenter, NetworkSegmenter):
        refinement = replace(refinement, split_bodies=False)
    keep_freed_memory()
    with input_file(data) as path, output_file(output) as target:
        reader = CloudsReader(path)
        sequences = sequences_of_split(reader, settings.input.split, data)
        flow = _choose_flow(settings, reader)
        estimator = find_estimator(flow)
        config = {"settings": _record(settings, refinement), **segmenter.record()}
        inputs = {"clouds": path, **({"flow": estimator} if estimator else {})}
        entry = describe_shard(provenance.record(config, seed, inputs), spread.shard)
        once = OncePerProcess(open_segmenter, json.dumps(entry["config"], default=str), segmenter)
        flow = str(estimator.resolve() if estimator else flow)
        work = PartsOfSequence(once, flow, str(choose_device(device)), refinement, seed, reader.length_unit)
        fields = [name for name in reader.fields if name not in ("part", *OF_PARTS)]
        _tell_of_input(data, reader, sequences, segmenter, refinement)
        if force or not already_made(target, entry, PartsReader, WORK):
            if settings.classical.method == "scene":
                for line in taken_for_meters(reader.path, reader.length_unit):
                    log.warn(line)
            with PartsWriter(
                target,
                num_parts=segmenter.slots,
                class_names=reader.class_names,
                length_unit=reader.length_unit,
                seed=seed,
                source=reader.path.name if data != "-" else "stdin",
                provenance=[*reader.provenance, entry],
                fields=[*fields, "part"],
                force=force,
                resume=output != "-",
            ) as writer:
                _predict_sequences(reader, sequences, work, writer, fields, spread, settings.classical)
        return _close(target, drawings, settings.classical.method == "scene")


def _tell_of_input(
    data: str, reader: CloudsReader, sequences: list[int], segmenter: Segmenter, refinement: Refinement
) -> None:
    """Says what of the sequences shows no motion, is not looked at, or takes much memory."""
    if isinstance(segmenter, MultibodySegmenter):
        still = [reader.names[i] for i in sequences if reader.frame_counts[i] < 2]
        if still:
            log.warn(f"{data}: one frame shows no motion: all is one part in {first_names(still)}")
        if not (segmenter.by_tracks and "track" in reader.fields):
            _tell_of_thinning(reader, sequences, refinement.points)
    if refinement.pairs == "all":
        _tell_of_many_pairs(reader, sequences, segmenter.slots)


def _tell_of_thinning(reader: CloudsReader, sequences: list[int], points: int) -> None:
    """Says how many points of a frame are looked at where frames have more and nobody said how many to take."""
    chosen = np.isin(np.repeat(np.arange(len(reader)), reader.frame_counts), sequences)
    most = int(reader.frame_sizes[chosen].max(initial=0))
    if points == Refinement.points and most > points:
        log.info(
            f"{reader.path}: {points} of up to {most:,} points of a frame are looked at, and parts that have few of them may be"
            f" missed; --points {min(4 * points, most)} shows smaller ones and takes longer"
        )


def _tell_of_many_pairs(reader: CloudsReader, sequences: list[int], slots: int) -> None:
    """Warns where the flows and motions between all pairs of a sequence's frames take more memory and disk than is expected."""
    from rich.filesize import decimal

    bytes_of = {}
    for index in sequences:
        others = max(int(reader.frame_counts[index]) - 1, 0)
        of_frames = reader.frame_counts[index] * slots * _MOTION_BYTES
        bytes_of[index] = others * int(reader.point_counts[index] * _FLOW_BYTES + of_frames)
    if bytes_of and max(bytes_of.values()) > _MUCH:
        large = max(bytes_of, key=bytes_of.__getitem__)
        frames, most = int(reader.frame_counts[large]), bytes_of[large]
        log.warn(
            f"{reader.path}: --pairs all: the flows and motions of the {frames * (frames - 1):,} pairs of frames of"
            f" {reader.names[large]} take {decimal(most)} of memory, and of all sequences {decimal(sum(bytes_of.values()))} of the"
            f" disk; with --pairs adjacent {decimal(most // frames)} of memory"
        )


def _record(settings: PredictSettings, refinement: Refinement) -> dict[str, Any]:
    """Returns the settings that shape the result, for the file's provenance: of the methods only the one that is used."""
    method = settings.classical.method
    said = {"input": asdict(settings.input), "refinement": asdict(refinement)}
    if settings.classical.classical:
        return said | {"classical": settings.classical.used()}
    return said | ({method: asdict(getattr(settings, method))} if method in ("multibody", "scene") else {})


def _open_segmenter(settings: PredictSettings, model: str | None, device: str, seed: int) -> Segmenter:
    """Returns the segmenter that the options ask for. Raises UsageError for options that contradict one another."""
    classical, chosen = settings.classical, choose_device(device)
    if classical.method == "network":
        return NetworkSegmenter.load(model or default_model(), chosen, wanted(settings.precision.amp, chosen))
    if settings.precision.amp:
        raise UsageError(f"amp = true: --method {classical.method} uses no network; add --fast, or leave it out")
    if model is not None:
        raise UsageError(f"--model {model}: --method {classical.method} uses no network; give one of both")
    if classical.method == "scene":
        return SceneSegmenter(settings.scene)
    if classical.method == "multibody":
        return MultibodySegmenter(settings.multibody, settings.input.flow in ("auto", "tracks"))
    points = settings.refinement.points
    if classical.parts is not None and classical.parts > points:
        raise UsageError(
            f"--parts {classical.parts}: more than the {points} points of a frame that are divided (--points)"
        )
    return ClassicalSegmenter(classical, seed)


def _choose_flow(settings: PredictSettings, reader: CloudsReader) -> str:
    """Returns the estimator of flow between frames, which multibody and scene need none of.

    Raises UsageError for a flow that the method can't use, or tracks that the file lacks.
    """
    flow, method = settings.input.flow, settings.classical.method
    if flow == "tracks" and method != "multibody":
        raise UsageError(
            f"--flow tracks: --method {method} doesn't read tracks; leave --method out, or give --flow icp"
        )
    if flow == "tracks" and "track" not in reader.fields:
        raise UsageError(f"--flow tracks: {reader.path} has no field track; leave --flow out, and motions are searched")
    own = {"multibody": ("auto", "tracks", "icp"), "scene": ("auto",)}
    if flow not in own.get(method, (flow,)):
        raise UsageError(
            f"--flow {flow}: {method} finds the motions itself; add --method network or a classical one, or leave it out"
        )
    if method == "multibody":
        _check_multibody(settings.multibody, reader, flow in ("auto", "tracks") and "track" in reader.fields)
    return "icp" if flow in ("auto", "tracks") else flow


def _check_multibody(settings: MultibodySettings, reader: CloudsReader, by_tracks: bool) -> None:
    """Raises UsageError for a setting of tracks where none are used; warns of those of the search where tracks are."""
    changed = [name for name, value in asdict(settings).items() if value != getattr(MultibodySettings, name)]
    if "flexible" in changed and not by_tracks:
        why = "--flow icp uses none" if "track" in reader.fields else f"{reader.path} has no field track"
        raise UsageError(f"flexible = {settings.flexible:g}: it belongs to tracks, and {why}; leave it out")
    unread = [name for name in changed if name not in ("flexible", "max_bodies")]
    if by_tracks and unread:
        log.warn(f"{', '.join(unread)}: not read where points have tracks; --flow icp searches by places instead")


def _predict_sequences(
    reader: CloudsReader,
    sequences: list[int],
    work: PartsOfSequence,
    writer: PartsWriter,
    fields: list[str],
    spread: Spread,
    classical: ClassicalSettings,
) -> None:
    """Writes the parts of the sequences that an earlier run has not written; warns of those with fewer than --parts asks for."""
    wanted_parts = 0 if classical.method == "dbscan" else classical.parts or 0  # the most that dbscan may find
    fewer: list[str] = []

    def write(place: int, done: tuple[CloudSequence, PartsSample]) -> dict[str, float]:
        sequence, sample = done
        if len(np.unique(sequence.part)) < wanted_parts:
            fewer.append(sequence.name)
        writer.write(sequence, sample.probability, sample.pairs, sample.motion, sample.flow)
        return {"frames": sequence.num_frames}

    def load(place: int) -> CloudSequence:
        return reader.read(sequences[place], fields=fields)

    names = [reader.names[index] for index in sequences]
    taken = ItemPass(writer, names, Wording("segment predict", "sequence", "divided"), spread.shard)
    with spread.workers() as workers:
        taken.run(work, load, write, workers)
    if fewer:
        log.warn(
            f"{reader.path}: fewer than the {wanted_parts} parts of --parts in {first_names(fewer)}: too few different points,"
            " or parts too small to be kept (--set smallest=0 --set smallest_cluster=0 keeps them)"
        )


def told_of_scenes(parts: str) -> list[str]:
    """Returns a line for each sequence of a parts file of scenes: the sensor's motion, moving objects, their speeds."""
    from dpcli.segment.scene.report import scene_lines

    with PartsReader(Path(parts)) as reader:
        return scene_lines(reader)


def _close(target: Path, drawings: Drawings, scene: bool) -> int:
    """Draws what was written and tells what was passed over; returns the number of sequences."""
    with PartsReader(target) as made:
        for line in skipped_lines(made.skipped):
            log.warn(line)
        if len(made):
            _draw(made, drawings, scene)
        return len(made)


def _draw(reader: PartsReader, drawings: Drawings, scene: bool) -> None:
    """Draws what was just written; scenes from above."""
    if drawings == Drawings():
        return
    from dpcli.draw.ply import write_ply_frames
    from dpcli.segment.pictures import parts_picture, turntable, usual_look
    from dpcli.segment.scene.report import picture_of_scene

    if drawings.picture is not None:
        shown = spread_places(len(reader), _ROWS)
        sequences, look = [reader.read(int(i)) for i in shown], usual_look(reader.provenance)
        if scene:
            sequences, looks = zip(*(picture_of_scene(one, reader.length_unit) for one in sequences))
            look = looks[0]
        parts_picture(drawings.picture, sequences, look=look)
        if len(shown) < len(reader):
            log.info(f"{drawings.picture}: shows {len(shown)} of {len(reader)} sequences, evenly chosen")
    if drawings.turntable is not None:
        turntable(drawings.turntable, reader.read(0), look=usual_look(reader.provenance, 320))
    if drawings.ply is not None:
        for index, name in enumerate(file_names(reader.names)):
            write_ply_frames(drawings.ply / name, reader.read(index))
