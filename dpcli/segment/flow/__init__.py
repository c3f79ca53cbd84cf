"""Scene flow between two frames: nearest points, rigid bodies found by ICP, or a network trained without labels."""

from __future__ import annotations

from dpcli.segment.flow.estimators import METHODS, estimate_flow

__all__ = ["METHODS", "estimate_flow"]
