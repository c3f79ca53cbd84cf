"""The confidence of a shape network: how much what it looks at is like the creatures it learned from, rather than a thing."""

from __future__ import annotations

import numpy as np

_WORTH = 4.0  # a creature that is taken for a thing loses more than a thing that is taken for a creature


def fit_confidence(creatures: np.ndarray, things: np.ndarray) -> list[float]:
    """Returns C weights of features and an offset, of which `confidence` makes a number.

    creatures f32 (N,C), things (M,C): overall features of pictures. It is a logistic regression on standardized features, with
    so strong a penalty that it tells plain things from the rest and leaves what is between to the creatures.
    """
    from sklearn.linear_model import LogisticRegression

    rows = np.concatenate([creatures, things]).astype(np.float64)
    known = np.arange(len(rows)) < len(creatures)
    mean, spread = rows.mean(0), np.maximum(rows.std(0), 1e-6)
    fitted = LogisticRegression(C=1 / len(rows), class_weight={True: _WORTH, False: 1.0}, max_iter=1000)
    fitted.fit((rows - mean) / spread, known)
    weights = fitted.coef_[0] / spread
    return [*map(float, weights), float(fitted.intercept_[0] - weights @ mean)]


def confidence(features: np.ndarray, fitted: list[float]) -> np.ndarray:
    """Returns the confidence f64 (B), 0..1, of overall features (B,C): 0.5 and above is for creatures."""
    logit = features.astype(np.float64) @ np.array(fitted[:-1]) + fitted[-1]
    return 1 / (1 + np.exp(-logit.clip(-700, 700)))
