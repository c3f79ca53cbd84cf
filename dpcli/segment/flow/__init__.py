"""This folder holds all that estimates scene flow: nearest points, rigid bodies by ICP, a network and its training.

Nothing here knows of part networks but their slot matching.
"""

from __future__ import annotations

from dpcli.segment.flow.estimators import METHODS, estimate_flow

__all__ = ["METHODS", "estimate_flow"]
