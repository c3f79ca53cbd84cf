"""dpc: a command-line toolkit for dynamic point clouds."""

from __future__ import annotations

__version__ = "0.1.0"
