"""Calibrated confidence, and the threshold below which nothing counts as recognized.

Temperature scaling (Guo et al. 2017): probabilities are raised to the power 1 / temperature and normalized again. The
best class stays the best; what changes is how sure it is.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError

NOTE = "confidence"  # the name under which a weights file's notes hold it
LEAST = 1e-12  # the probability that 0 is taken for: one sure mistake must not decide alone
_SHARE = 0.95  # of the still clips that a fitted threshold rejects, and of the actions that it keeps at least
_PRIOR = 0.5  # deviation of log temperature before any video is seen
_RANGE = (-3.0, 3.0)  # of log temperature


@dataclass(frozen=True)
class Confidence:
    """Holds a temperature, and the least confidence of an action, 0 where nothing is rejected.

    The rest tells where they come from: clips that were fitted to, shares of action clips kept and of still clips
    rejected on them, and `source` in words.
    """

    temperature: float = 1.0
    threshold: float = 0.0
    clips: int = 0
    kept: float | None = None
    rejected_still: float | None = None
    source: str = ""

    def of(self, scores: np.ndarray) -> np.ndarray:
        """Returns the calibrated probabilities f64 (...,C) of scores f (...,C).

        >>> Confidence(temperature=2.0).of(np.array([0.9, 0.1])).round(2).tolist()
        [0.75, 0.25]
        """
        logits = log_probabilities(scores) / self.temperature
        powers = np.exp(logits - logits.max(-1, keepdims=True))
        return powers / powers.sum(-1, keepdims=True)

    def notes(self) -> dict[str, Any]:
        """Returns the fields by name, as the notes of a weights file hold them."""
        return asdict(self)


def log_probabilities(scores: np.ndarray) -> np.ndarray:
    """Returns the logarithms f64 of probabilities of any shape, of 0 that of 1e-12."""
    return np.log(np.clip(np.asarray(scores, np.float64), LEAST, None))


def stored_confidence(notes: dict[str, Any]) -> Confidence | None:
    """Returns what a weights file's notes say; None for weights from before there was any, or without validation videos.

    Raises DataError for notes that make no sense.
    """
    if NOTE not in notes:
        return None
    try:
        found = Confidence(**notes[NOTE])
        sound = 0 < found.temperature < np.inf and 0 <= found.threshold <= 1
    except TypeError:
        sound = False
    if not sound:
        raise DataError(
            f"the weights' notes should hold a temperature and a threshold, but hold {str(notes[NOTE])[:80]!r}; train again"
        )
    return found


def choose_confidence(notes: dict[str, Any], reject_below: str | None, model: str) -> Confidence:
    """Returns the confidence that a command works with: the model's own, or without one its plain probabilities.

    reject_below: `auto` (the model's own threshold), a number from 0 to 1, or None: `auto` where the model has one, else
    nothing is rejected. Raises UsageError for `auto` without one and for what is no such number.
    """
    own = stored_confidence(notes)
    if reject_below is None:
        return own or Confidence()
    if reject_below == "auto":
        if own is None:
            raise UsageError(
                f"--reject-below auto: {model} has no threshold of its own, as it was trained without validation videos;"
                " give a number such as 0.4"
            )
        return own
    try:
        threshold = float(reject_below)
    except ValueError:
        threshold = -1.0
    if not 0 <= threshold <= 1:
        raise UsageError(f"--reject-below {reject_below}: expected auto, or a number from 0 to 1")
    base = own or Confidence()
    return Confidence(base.temperature, threshold, source="--reject-below")


def fit_confidence(scores: np.ndarray, labels: np.ndarray, still: np.ndarray, source: str) -> Confidence:
    """Returns temperature and threshold fitted to clips that the network has not learned from.

    scores f (S,C), labels i (S): of clips of actions. still f (N,C): of clips in which nobody moves. The temperature
    minimizes the negative log-likelihood, with a log-normal prior (deviation 0.5 about 1) that a few videos, or ones that
    are all right, can't drag away. The threshold rejects 95 % of the still clips, as long as it keeps 95 % of the actions.
    """
    temperature = _fit_temperature(scores, labels)
    base = Confidence(temperature)
    sure, idle = (base.of(values).max(-1) if len(values) else np.zeros(0) for values in (scores, still))
    threshold = _fit_threshold(sure, idle)
    kept = float((sure >= threshold).mean())
    rejected = float((idle < threshold).mean()) if len(idle) else None
    return Confidence(temperature, threshold, len(scores), kept, rejected, source)


def _fit_temperature(scores: np.ndarray, labels: np.ndarray) -> float:
    from scipy.optimize import minimize_scalar
    from scipy.special import logsumexp

    logits = log_probabilities(scores)
    true = logits[np.arange(len(labels)), labels]

    def loss(log_temperature: float) -> float:
        sharp = np.exp(-log_temperature)
        likelihood = (sharp * true - logsumexp(sharp * logits, axis=-1)).sum()
        return float(log_temperature**2 / (2 * _PRIOR**2) - likelihood)

    return round(float(np.exp(minimize_scalar(loss, bounds=_RANGE, method="bounded").x)), 4)


def _fit_threshold(sure: np.ndarray, idle: np.ndarray) -> float:
    """Returns the least confidence of an action, from the confidences of actions and of still clips."""
    most = float(np.quantile(sure, 1 - _SHARE, method="lower"))
    wanted = float(np.quantile(idle, _SHARE, method="higher")) if len(idle) else 0.0
    return int(1e4 * min(most, wanted)) / 1e4  # rounded down: the action at the threshold is kept
