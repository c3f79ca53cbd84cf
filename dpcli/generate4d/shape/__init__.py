"""Knowledge of shape from one picture: layers of depth and color, and the priors that predict them."""

from __future__ import annotations
