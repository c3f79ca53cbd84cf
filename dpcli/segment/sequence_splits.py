"""The sequences of a clouds file that a command takes, and those that a training holds out."""

from __future__ import annotations

from dpcli.errors import DataError, UsageError
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.store import CloudsReader


def sequences_of_split(reader: CloudsReader, split: str, name: str) -> list[int]:
    """Returns the numbers of the sequences of a split, or of `all`. Raises DataError, naming the file, when it has none."""
    chosen = [i for i, own in enumerate(reader.splits) if split == "all" or own == split]
    if not chosen:
        raise DataError(f"{name}: no sequence of split {split!r}; it has {sorted(set(reader.splits))}")
    return chosen


def hold_out_sequences(reader: CloudsReader, validation: str, seed: int) -> tuple[list[int], list[int]]:
    """Returns the (training, validation) sequences of two frames or more.

    Training: split `train`, or what has no split when nothing is named so. validation: `auto`, the split `validation` if
    there is one, else nothing; `none`; a fraction of the training sequences; class names with commas, held out whole.
    Raises DataError where there is nothing to train on, UsageError for a fraction or class that can't be.
    """
    long = [i for i in range(len(reader)) if reader.frame_counts[i] >= 2]
    train = [i for i in long if reader.splits[i] == "train"] or [i for i in long if reader.splits[i] == ""]
    if not train:
        raise DataError(
            f"{reader.path}: no sequence of split 'train', or without a split, has two frames or more; its splits are"
            f" {', '.join(map(repr, sorted(set(reader.splits))))} (`dpc prepare split` makes others)"
        )
    if validation in ("auto", "none"):
        held = [i for i in long if reader.splits[i] in ("validation", "val")] if validation == "auto" else []
        return train, held
    try:
        share = float(validation)
    except ValueError:
        left, held = _hold_out_classes(reader, train, validation)
    else:
        if not 0 < share < 1:
            raise UsageError(f"--validation {validation}: expected auto, none, a fraction below 1, or class names")
        order = generator(seed, SegmentStream.VALIDATION).permutation(len(train))
        count = max(1, round(share * len(train)))
        left, held = [train[i] for i in sorted(order[count:])], [train[i] for i in sorted(order[:count])]
    if not left:
        raise UsageError(
            f"--validation {validation}: holds out all of the {len(train)} training sequences; none is left to train on"
        )
    return left, held


def _hold_out_classes(reader: CloudsReader, train: list[int], names: str) -> tuple[list[int], list[int]]:
    """Returns the training sequences without and with the classes named, with commas between the names."""
    classes = [word.strip() for word in names.split(",")]
    unknown = [name for name in classes if name not in reader.class_names]
    if unknown:
        raise UsageError(
            f"--validation {names}: no class {unknown[0]!r}; the file has {', '.join(reader.class_names) or 'none'}"
        )
    held = [i for i in train if reader.labels[i] >= 0 and reader.class_names[reader.labels[i]] in classes]
    return [i for i in train if i not in set(held)], held
