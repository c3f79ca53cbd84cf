"""The weights that a training begins with when it goes on from a model: what fits is taken, classes by their names."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from dpcli.errors import UsageError
from dpcli.path_names import first_names
from dpcli.runtime.progress import log

_CLASSIFIER = "classify"  # in the name of a layer whose rows are classes
_GROWN = "forest"  # in the name of what no training goes on from: forests are grown at its end


def take_weights(
    mine: nn.Module, theirs: nn.Module, class_names: Sequence[str], their_names: Sequence[str], what: str
) -> None:
    """Copies the weights whose names and shapes agree, and of the classifiers the rows of the classes that both know by name:
    another class in the same place would have to be unlearned first.

    Raises UsageError when fewer than half of the tensors fit.
    """
    own, others = mine.state_dict(), theirs.state_dict()
    shared = {k: their_names.index(name) for k, name in enumerate(class_names) if name in their_names}
    taken: dict[str, Tensor] = {}
    for key, value in own.items():
        other = None if _is_grown(key) else others.get(key)
        if other is not None and _CLASSIFIER in key.split("."):
            other = _by_class(value, other, shared, (len(class_names), len(their_names)))
        if other is not None and other.shape == value.shape:
            taken[key] = other
    _check_most_fit(own, others, taken, what)
    mine.load_state_dict({**own, **taken})
    missing = [key for key in own if key not in taken and not _is_grown(key)]
    known = [class_names[k] for k in shared]
    log.info(f"{what}: " + "; ".join(_told(missing, known, len(class_names), any(map(_is_grown, own)))))


def _by_class(own: Tensor, other: Tensor, shared: dict[int, int], classes: tuple[int, int]) -> Tensor | None:
    """Returns a classifier's tensor with the rows of the shared classes from the other one; None where its layer reads
    something else.

    shared: number of a class here -> there. Rows are the classes, or all of them for each kind of copy of a clip.
    """
    if own.shape[1:] != other.shape[1:] or len(own) % classes[0] or len(other) % classes[1]:
        return None
    mixed, known = own.clone().unflatten(0, (-1, classes[0])), other.unflatten(0, (-1, classes[1]))
    if len(mixed) != len(known):
        return None
    mixed[:, list(shared)] = known[:, list(shared.values())].to(mixed)
    return mixed.flatten(0, 1)


def _is_grown(key: str) -> bool:
    return any(word.startswith(_GROWN) for word in key.split("."))


def _check_most_fit(own: dict[str, Tensor], others: dict[str, Tensor], taken: dict[str, Tensor], what: str) -> None:
    """Raises UsageError when fewer than half of the tensors fit."""
    weights = [key for key, value in own.items() if value.dim() > 1 and not _is_grown(key)]
    if 2 * sum(key in taken for key in weights) < len(weights):
        key = next((key for key in weights if key not in taken), "?")
        shape = tuple(others[key].shape) if key in others else "absent"
        raise UsageError(
            f"{what}: another network ({key}: {shape}, here {tuple(own[key].shape)}); give the same --preset and backbone"
        )


def _told(missing: list[str], known: list[str], classes: int, forests: bool) -> list[str]:
    """Returns the parts of the sentence about what was taken and what begins from nothing."""
    parts = ["weights taken"]
    if len(known) < classes:
        knows = (
            f"{len(known)} of {classes} classes by name ({first_names(known)})"
            if known
            else f"none of the {classes} classes"
        )
        parts.append(f"it knows {knows}, so the last layers learn {'the others' if known else 'them'} from nothing")
    if forests:
        parts.append("forests are grown anew at the end")
    if missing:
        parts.append(f"from nothing: {first_names(missing)}")
    return parts
