"""Multi-body motion segmentation of a whole sequence: one label per point, one rigid motion per body and frame."""

from __future__ import annotations
