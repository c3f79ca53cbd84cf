"""The division of a file's videos into those that train and those that validate: what the file says, or carved from the
training videos; never the test ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dpcli.classify.network.config import CROSS
from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.path_names import first_names
from dpcli.runtime.seeds import ClassifyStream, generator
from dpcli.store import CloudsReader

_FREQUENT = 0.5  # of the videos, from which on one class may hide how the others do


def labeled(reader: CloudsReader, split: str) -> list[int]:
    """Returns the sequences of this split that have a label. Raises DataError when there are none."""
    chosen = [i for i, name in enumerate(reader.splits) if name == split and reader.labels[i] >= 0]
    if not chosen:
        raise DataError(f"{reader.path}: no labeled sample of split {split!r}; {_instead(reader)}")
    return chosen


def _instead(reader: CloudsReader) -> str:
    """Returns a sentence about what a file without training samples has, and how it comes by some."""
    if reader.labels.max(initial=-1) < 0:
        return "none has a label: prepare them with --labels TABLE or, where a folder is a class, --label-from-folder"
    if not any(reader.splits):
        name = f"{reader.path.stem}-split.h5"
        return f"none has a split: `dpc prepare split {reader.path} -o {name} --fractions 0.8,0,0.2` divides them"
    return f"the file has {', '.join(sorted({repr(name) for name in reader.splits}))}"


def carve_validation(reader: CloudsReader, rule: str, seed: int) -> tuple[list[int], list[int]]:
    """Returns the training and the validation sequences, both of the split `train` but for the rule `split`.

    `rule`: `none`; `cross` (all videos do both, see `cross_folds`); `split` (the file's own); `subject` (the training subject
    with the highest number); `subjects:3,5`; `fold:3/10` (see `folds`); or a fraction such as `0.15`, drawn for each class.
    """
    chosen = labeled(reader, "train")
    if rule == "none":
        return chosen, []
    if rule == CROSS:
        return chosen, chosen
    if rule == "split":
        return chosen, labeled(reader, "validation")
    if rule.startswith("fold"):
        return _one_fold(reader, chosen, rule, seed)
    if rule.startswith("subject"):
        held = _held_out(reader, chosen, rule)
        rest = [i for i in chosen if reader.subjects[i] not in held]
        return rest, [i for i in chosen if reader.subjects[i] in held]
    try:
        share = float(rule)
    except ValueError:
        share = -1
    if not 0 < share < 1:
        raise UsageError(
            f"--validation {rule}: expected none, split, cross, subject, subjects:3,5, fold:3/10 or a fraction such as 0.15"
        )
    return _stratified(reader, chosen, share, seed)


def _held_out(reader: CloudsReader, chosen: list[int], rule: str) -> set[int]:
    subjects = {int(reader.subjects[i]) for i in chosen}
    if max(subjects) < 0:
        raise UsageError(
            f"--validation {rule}: {reader.path} doesn't say who is seen; a column subject in --labels of `dpc prepare` does, or give"
            " a fraction such as 0.15"
        )
    held = {max(subjects)} if rule == "subject" else people_of(rule)
    if not held < subjects:
        raise UsageError(
            f"--validation {rule}: training subjects are {sorted(subjects)}; hold out some of them, not all"
        )
    return held


def people_of(rule: str) -> set[int]:
    """Returns the people that a rule such as `subjects:3,5` names. Raises UsageError where it names none."""
    try:
        return {int(word) for word in rule.split(":", 1)[1].split(",")}
    except (IndexError, ValueError):
        raise UsageError(f"--validation {rule}: expected subjects:3,5") from None


def _stratified(reader: CloudsReader, chosen: list[int], share: float, seed: int) -> tuple[list[int], list[int]]:
    held: set[int] = set()
    of_label: dict[int, list[int]] = {}
    for i in chosen:
        of_label.setdefault(int(reader.labels[i]), []).append(i)
    for label, members in sorted(of_label.items()):
        count = min(round(share * len(members)), len(members) - 1)
        held.update(
            int(members[k])
            for k in generator(seed, ClassifyStream.HELD_OUT_SAMPLES, label).permutation(len(members))[:count]
        )
    return [i for i in chosen if i not in held], sorted(held)


def folds(labels: np.ndarray, subjects: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Returns the number of the fold, of `count`, that each video is in, i64 (N), for cross-validation (thesis, figure 3.5).

    labels, subjects: i32 (N). Whole subjects share a fold where all are known and there are at least `count` of them,
    as FlickerNet leaves subjects out; else each class is spread over the folds, whose sizes differ by at most one.
    The same seed gives the same folds whichever of them is asked for.
    """
    people = np.unique(subjects)
    fold = np.empty(len(labels), np.int64)
    if len(people) >= count and people[0] >= 0:
        for place, k in enumerate(generator(seed, ClassifyStream.HELD_OUT_PEOPLE).permutation(len(people))):
            fold[subjects == people[k]] = place % count
        return fold
    members = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    shuffled = [
        own[generator(seed, ClassifyStream.HELD_OUT_PEOPLE, k).permutation(len(own))] for k, own in enumerate(members)
    ]
    fold[np.concatenate(shuffled)] = np.arange(len(labels)) % count
    return fold


def cross_folds(reader: CloudsReader, chosen: list[int], members: int, seed: int) -> dict[int, int]:
    """Returns the member, of `members`, that must not learn from each of the videos: whole people where at least two are known."""
    subjects = reader.subjects[chosen]
    people = len(set(subjects.tolist()))
    count = min(members, people) if people > 1 and subjects.min() >= 0 else members
    return dict(zip(chosen, folds(reader.labels[chosen], subjects, count, seed).tolist()))


def _one_fold(reader: CloudsReader, chosen: list[int], rule: str, seed: int) -> tuple[list[int], list[int]]:
    try:
        which, count = (int(word) for word in rule.removeprefix("fold:").split("/"))
    except ValueError:
        which, count = -1, 0
    if not 0 <= which < count or count < 2:
        raise UsageError(
            f"--validation {rule}: expected fold:I/N with I = 0 ... N-1 and N at least 2, such as fold:3/10"
        )
    if count > len(chosen):
        raise UsageError(
            f"--validation {rule}: {count} folds of {counted(len(chosen), 'training video')}; ask for fewer folds"
        )
    of = folds(reader.labels[chosen], reader.subjects[chosen], count, seed)
    return [i for i, k in zip(chosen, of) if k != which], [i for i, k in zip(chosen, of) if k == which]


def lasting_rule(reader: CloudsReader, rule: str, validation: list[int]) -> str:
    """Returns the rule that says later, of other files too, what was held out: a person by number, as another file may have
    others, and `none` where a rule found nothing to hold out."""
    if not validation:
        return "none"
    return f"subjects:{int(reader.subjects[validation[0]])}" if rule == "subject" else rule


def default_rule(reader: CloudsReader, members: int = 1) -> str:
    """Returns `split` when the file has labeled validation videos, `cross` for a network of several members, or `none` where
    each class has one video, `subject` when the training videos have several known subjects, else 15 % of each class."""
    if any(name == "validation" and label >= 0 for name, label in zip(reader.splits, reader.labels)):
        return "split"
    if members > 1:
        labels = reader.labels[labeled(reader, "train")]
        return CROSS if len(labels) > len(np.unique(labels)) else "none"
    subjects = {int(reader.subjects[i]) for i in labeled(reader, "train")}
    return "subject" if len(subjects) > 1 and min(subjects) >= 0 else "0.15"


def about_classes(reader: CloudsReader, judges: dict[int, int]) -> str:
    """Returns how many videos can't be judged right, since their judge saw no other of their class, "" where all can.

    judges: by video, the fold whose networks never saw it, as from `cross_folds`.
    """
    folds_of: dict[int, set[int]] = {}
    for i, fold in judges.items():
        folds_of.setdefault(int(reader.labels[i]), set()).add(fold)
    lone = sum(len(folds_of[int(reader.labels[i])]) == 1 for i in judges)
    if not lone:
        return ""
    return (
        f"{lone} of these videos count as wrong, since all of their class, such as one video or one person's, were held out"
        " together; new videos may come out better"
    )


def about_absent_classes(reader: CloudsReader, training: list[int], validation: list[int]) -> str:
    """Returns which of the classes that were learned no validation video shows, for the user, "" where all are there or nothing
    is held out."""
    learned, judged = ({int(reader.labels[i]) for i in some} for some in (training, validation))
    names = class_table(reader)
    absent = [names[label] for label in sorted(learned - judged)]
    if not judged or not absent:
        return ""
    return (
        f"none of them is of {len(absent)} of the {len(learned)} classes that were learned: {first_names(absent)}; how well these are"
        " recognized is unknown"
    )


def about_frequent_class(reader: CloudsReader, judged: Sequence[int]) -> str:
    """Returns how many judged videos are right for whoever always names their most frequent class, for the user, "" where classes
    are about equal."""
    labels, counts = np.unique(reader.labels[list(judged)], return_counts=True)
    most = int(counts.max(initial=0))
    if not len(counts) or most < len(judged) * max(_FREQUENT, 1.5 / len(counts)):
        return ""
    name = class_table(reader)[labels[counts.argmax()]]
    return (
        f"{most} of these videos are of class {name}, so always naming it has {100 * most / len(judged):.1f} % right (the mean over"
        " classes: `dpc evaluate classification`, balanced accuracy)"
    )


def about_other_splits(reader: CloudsReader) -> str:
    """Returns which videos neither train nor judge, as they are of no split or of one that isn't known, "" where there are none."""
    others: dict[str, list[str]] = {}
    for name, split in zip(reader.names, reader.splits):
        if split not in ("train", "validation", "test"):
            others.setdefault(split, []).append(name)
    told = []
    for other, names in others.items():
        whose = f"of the split {other!r}" if other else "of no split"
        told.append(f"{counted(len(names), 'video')} {whose} left out: {first_names(names)}")
    return "; ".join(told)


def about_people(reader: CloudsReader, training: list[int], validation: list[int]) -> str:
    """Returns a caveat about the validation accuracy for the user, "" where no person is in both training and validation."""
    learned, judged = ({int(reader.subjects[i]) for i in some} for some in (training, validation))
    if not judged:
        return ""
    if min(learned | judged) < 0:
        return (
            f"{unknown_people(reader, [*training, *validation])}; if the same people train and validate, people never seen come out"
            " lower (a column subject in --labels holds whole people out)"
        )
    if training is validation and len(judged) > 1:
        return ""  # each by networks that saw other people
    shared = len(learned & judged)
    who = f"{shared} {'person trains and validates' if shared == 1 else 'people train and validate'}"
    return f"{who}: people never seen come out lower (--validation subject holds whole people out)" if shared else ""


def unknown_people(reader: CloudsReader, videos: Sequence[int]) -> str:
    """Returns in how many of these videos, of which it is unknown in one at least, the file doesn't say who is seen."""
    own = np.unique(videos)
    unknown = int((reader.subjects[own] < 0).sum())
    return "the file doesn't say who is seen" + (f" in {unknown} of {len(own)} videos" if unknown < len(own) else "")


def about_tested_people(reader: CloudsReader, training: list[int], tests: list[int]) -> str:
    """Returns how many people of the file's tests are learned from, too, for the user, "" where none is."""
    learned, tested = ({int(reader.subjects[i]) for i in some} - {-1} for some in (training, tests))
    shared = len(learned & tested)
    if not shared:
        return ""
    return (
        f"{shared} of {counted(len(tested), 'person', 'people')} in the split 'test' {'is' if shared == 1 else 'are'} learned from, too:"
        " people never seen come out lower (`dpc prepare split --by-subject` keeps people apart)"
    )


def class_table(reader: CloudsReader) -> list[str]:
    """Returns the class names; numbers where the file has labels but no names."""
    if reader.class_names:
        return reader.class_names
    return [str(i) for i in range(int(np.max(reader.labels)) + 1)]
