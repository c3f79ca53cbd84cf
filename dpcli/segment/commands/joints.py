"""Does the work of `dpc segment joints`; the options are in `cli/segment/joints.py`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from dpcli.draw.view import upright_axis
from dpcli.errors import DataError, UsageError
from dpcli.path_names import file_names, first_names
from dpcli.runtime import provenance
from dpcli.runtime.progress import Progress, log
from dpcli.runtime.whole_file import PICTURES, check_target, make_folder, refuse_existing, refuse_replacing, whole_file
from dpcli.segment.frame_pairs import first_copies
from dpcli.segment.kinematics.joints_picture import joints_picture
from dpcli.segment.kinematics.kinematic_tree import KinematicTree, joint_counts, kinematic_tree, unseen_motions
from dpcli.segment.kinematics.urdf_writer import tree_json, write_trees, write_urdf
from dpcli.segment.multibody.axis_choice import with_point_axes
from dpcli.store import CloudSequence, input_file, output_file
from dpcli.store.joints import FIXED, PRISMATIC, REVOLUTE
from dpcli.store.parts import PartsReader, PartsWriter
from dpcli.store.schema import taken_for_meters

SUFFIXES = (".h5", ".urdf", ".json")


def find_joints(parts: str, output: Path, *, sequence: str | None, picture: Path | None, force: bool) -> Counter[str]:
    """Finds the joints of the sequences of a parts file, or of one, and returns how many of each type there are.

    output: `.h5` or `-` (a pipe), a parts file that holds the joints too; `.urdf`, one object, with a folder of meshes beside it; `.json`;
    a folder for a URDF of each sequence. picture: of the one, or the first. Raises UsageError for an output that exists
    (without `force`) or can't hold what was asked for, DataError for a sequence whose motions are unknown.
    """
    suffix = output.suffix.lower()
    if str(output) != "-":
        (refuse_existing if suffix in SUFFIXES else refuse_replacing)(output, force)
    if picture is not None:
        check_target(picture, "--picture", PICTURES)
    with input_file(parts) as path, PartsReader(path) as reader:
        chosen = _chosen(reader, sequence)
        if suffix == ".urdf" and len(chosen) > 1:
            raise UsageError(
                f"-o {output}: one object, but {path.name} has {len(chosen)} sequences; name one with --sequence, or a folder"
            )
        if suffix not in (".h5", ".json") and str(output) != "-":  # a URDF has meters
            for line in taken_for_meters(reader.path, reader.length_unit):
                log.warn(line)
        counts: Counter[str] = Counter()
        with closing(_trees(reader, chosen, counts, picture)) as trees:  # its bar ends before an error is told
            if str(output) == "-":
                with output_file("-") as target:
                    _write_parts(trees, target, reader, force)
            else:
                _WRITERS.get(suffix, _write_folder)(trees, output, reader, force)
    return counts


def _chosen(reader: PartsReader, sequence: str | None) -> list[int]:
    if sequence is None:
        return list(range(len(reader)))
    if sequence not in reader.names:
        raise UsageError(f"--sequence {sequence}: not in {reader.path}; it has {first_names(reader.names)}")
    return [reader.names.index(sequence)]


Trees = Generator[tuple[int, CloudSequence, KinematicTree], None, None]


def _trees(reader: PartsReader, chosen: list[int], counts: Counter[str], picture: Path | None) -> Trees:
    late, unseen, simplified = [], [], []
    with Progress("joints", len(chosen), "sequence") as progress:
        for number, index in enumerate(chosen):
            sequence = reader.read(index)
            if not (sequence.part >= 0).any():
                raise DataError(f"{reader.path}: {sequence.name!r} has no point in any part; predict its parts first")
            once = _without_copies(sequence)
            tree = with_point_axes(once, kinematic_tree(once, reader.read_parts(index)))
            counts.update(joint_counts(tree))
            late += [f"part {part} of {sequence.name}" for part in tree.trajectories.ids[~tree.trajectories.seen[0]]]
            for told, kinds in ((unseen, (FIXED,)), (simplified, (REVOLUTE, PRISMATIC))):
                told += [
                    f"part {child} on part {parent} of {sequence.name}" for child, parent in unseen_motions(tree, kinds)
                ]
            if picture is not None and number == 0:
                joints_picture(picture, tree, sequence.name, upright_axis(reader.provenance))
            yield index, sequence, tree
            progress.advance()
    if late:
        log.warn(
            f"{reader.path}: hardly a point in frame 0, so that the place there, and with it the joint, is a guess:"
            f" {first_names(late)}"
        )
    if unseen:
        log.warn(
            f"{reader.path}: joints called fixed, since points don't show the motion that the file tells (too few, or alike"
            f" before and after it; more points may): {first_names(unseen)}"
        )
    if simplified:
        log.warn(
            f"{reader.path}: joints called hinge or slide, though the motion that the file tells is another one; points don't"
            f" show the difference surely, and the joint may be free: {first_names(simplified)}"
        )


def _without_copies(sequence: CloudSequence) -> CloudSequence:
    """Returns the sequence with each point of a frame's part once: copies would make distances between neighbors 0."""
    frame = np.repeat(np.arange(sequence.num_frames), np.diff(sequence.frame_offsets))
    rows = first_copies(np.column_stack([frame, sequence.part, sequence.points.astype(np.float64)]))
    once = replace(sequence)
    once.take_points(rows, np.searchsorted(frame[rows], np.arange(sequence.num_frames + 1)))
    return once


def _write_parts(trees: Trees, output: Path, reader: PartsReader, force: bool) -> None:
    """Writes the parts file again, with the joints as a further field."""
    fields = [name for name in reader.fields if name != "joint"]
    history = [*reader.provenance, provenance.record({}, 0, {"parts": reader.path})]
    with PartsWriter(
        output,
        num_parts=reader.num_parts,
        class_names=reader.class_names,
        length_unit=reader.length_unit,
        source=reader.path.name,
        provenance=history,
        fields=[*fields, "joint"],
        force=force,
    ) as writer:
        for index, sequence, tree in trees:
            sequence.joint = tree.as_field(sequence.num_frames, reader.num_parts)
            said = reader.read_parts(index)
            writer.write(sequence, said.probability, said.pairs, said.motion, said.flow)


def _write_urdf(trees: Trees, output: Path, reader: PartsReader, force: bool) -> None:
    for _, sequence, tree in trees:
        write_urdf(output, tree, sequence.name, reader.length_unit)
        log.info(f"{output}: {len(tree.points)} links; meshes in {output.stem}_meshes")


def _write_json(trees: Trees, output: Path, reader: PartsReader, force: bool) -> None:
    write_trees(output, [tree_json(tree, sequence, reader.length_unit) for _, sequence, tree in trees])


def _write_folder(trees: Trees, output: Path, reader: PartsReader, force: bool) -> None:
    if output.suffix:
        raise UsageError(f"-o {output}: expected a name that ends in {', '.join(SUFFIXES)}, or a folder")
    if output.exists():  # replaced by --force, which keeps what else is there
        _fill_folder(output, trees, reader)
        return
    make_folder(output.parent)
    with whole_file(output) as folder:  # a stop leaves no half of it, and the same command may run again
        make_folder(folder)
        _fill_folder(folder, trees, reader)


def _fill_folder(folder: Path, trees: Trees, reader: PartsReader) -> None:
    objects, names = [], file_names(reader.names)
    for index, sequence, tree in trees:
        write_urdf(folder / f"{names[index]}.urdf", tree, sequence.name, reader.length_unit)
        objects.append(tree_json(tree, sequence, reader.length_unit))
    write_trees(folder / "joints.json", objects)


_WRITERS: dict[str, Callable[[Trees, Path, PartsReader, bool], None]] = {
    ".h5": _write_parts,
    ".urdf": _write_urdf,
    ".json": _write_json,
}
