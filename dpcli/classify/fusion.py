"""The fusion of several models' scores: their weighted mean (thesis A.2.1), and the weights that suit labeled videos best.

Arithmetic as the thesis writes it, or geometric, which is the mean of logits that the published code takes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dpcli.classify.confidence import LEAST, log_probabilities
from dpcli.counted import counted
from dpcli.errors import UsageError

MEANS = ("arithmetic", "geometric")
_STEPS = 10_000  # of expectation-maximization; some hundred are usual
_POWER = 100.0  # scores are taken to no higher power: where every model is right, none would be high enough


def parse_weights(text: str | None, names: Sequence[str], named: bool = False) -> np.ndarray:
    """Returns weights f64 (K) that sum to 1, from `0.5,0.5` or `static=0.3,dynamic=0.7`; None weighs all alike.

    named: names are needed, as streams have no order to go by. Raises UsageError when they don't fit.

    >>> parse_weights("3,1", ["points", "flow"]).tolist()
    [0.75, 0.25]
    """
    if text is None:
        return np.full(len(names), 1 / len(names))
    words = text.split(",")
    if named or "=" in text:
        pairs = dict(word.partition("=")[::2] for word in words)
        if set(pairs) != set(names) or len(pairs) != len(words):
            raise UsageError(f"--weights {text}: expected {','.join(f'{name}=NUMBER' for name in names)}")
        words = [pairs[name] for name in names]
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        raise UsageError(f"--weights {text}: expected numbers with commas, such as 0.5,0.5") from None
    if len(values) != len(names):
        raise UsageError(
            f"--weights {text}: {counted(len(values), 'weight')} for {counted(len(names), 'file')}; one for each"
        )
    if not np.isfinite(values).all() or values.min() < 0 or not 0 < values.sum() < np.inf:
        raise UsageError(f"--weights {text}: expected numbers from 0 up, not all of them 0")
    return values / values.sum()


def mean_scores(scores: np.ndarray, weights: np.ndarray, mean: str) -> np.ndarray:
    """Returns the mean f64 (S,C) of what K models say, scores (K,S,C), by weights (K) of sum 1; the models' order makes no
    difference.

    geometric: the product of the scores to the power of their weights, normalized to sum 1: softmax of the mean of logits. A
    class needs every model's consent, where arithmetic lets the surest one decide.

    >>> scores = np.array([[[0.9, 0.1]], [[0.5, 0.5]]])
    >>> mean_scores(scores, np.array([0.5, 0.5]), "arithmetic").round(3).tolist()
    [[0.7, 0.3]]
    >>> mean_scores(scores, np.array([0.5, 0.5]), "geometric").round(3).tolist()
    [[0.75, 0.25]]
    """
    if mean == "arithmetic":
        return np.sort(scores * weights[:, None, None], axis=0).sum(0)
    from scipy.special import softmax

    return softmax(np.sort(log_probabilities(scores) * weights[:, None, None], axis=0).sum(0), -1)


def geometric_weights(scores: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Returns weights f64 (K), sum 1, of the geometric mean of scores (K,S,C) for labels i (S), by likelihood.

    Fitted as powers from 0 up whose sum is free, as that says how sure the mean is and not which class it names: a convex
    problem (multinomial regression without an intercept), solved by L-BFGS.
    """
    from scipy.optimize import minimize
    from scipy.special import logsumexp, softmax

    logits = log_probabilities(scores)
    true = logits[:, np.arange(len(labels)), labels]  # (K,S)

    def loss(powers: np.ndarray) -> tuple[float, np.ndarray]:
        """Returns the mean negative log-likelihood of the powers, and its gradient."""
        mixed = np.tensordot(powers, logits, 1)
        expected = np.einsum("ksc,sc->ks", logits, softmax(mixed, -1))
        return float((logsumexp(mixed, -1) - powers @ true).mean()), (expected - true).mean(1)

    start = np.full(len(logits), 1 / len(logits))
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=[(0, _POWER)] * len(logits)).x
    return found / found.sum() if found.sum() > 0 else start


def likelihood_weights(probabilities: np.ndarray) -> np.ndarray:
    """Returns weights f64 (K), sum 1, of the arithmetic mean that gives labeled samples the greatest likelihood.

    probabilities: (K,S), what each of K models gives the true class of each sample. The logarithm of the likelihood, sum_s log
    sum_k w_k p_ks, is concave in w, so expectation-maximization from equal weights ends at its maximum.
    """
    found = np.clip(np.asarray(probabilities, np.float64), LEAST, None)
    weights = np.full(len(found), 1 / len(found))
    for _ in range(_STEPS):
        shares = weights[:, None] * found
        new = (shares / shares.sum(0)).mean(1)
        if np.abs(new - weights).max() < 1e-10:
            break
        weights = new
    return new
