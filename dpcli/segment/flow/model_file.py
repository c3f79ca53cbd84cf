"""A flow network on disk, and its answer for clouds of any size and unit of length."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpcli.ops import fps, gather_points, three_nn_interpolate
from dpcli.runtime.weights import find_weights, load_state, load_weights, save_weights
from dpcli.segment.flow.config import FlowConfig
from dpcli.segment.flow.flow_network import FlowNetwork

_FORMAT, _MAKER = "dpc-flow-1", "dpc segment flow"
_MOST, _FEWEST = 2048, 16  # points the network sees at once; fewer than the latter move as one


def save_flow_model(path: Path, model: FlowNetwork, notes: dict) -> None:
    """Weights as float32, configuration and notes (a small JSON object) in the header."""
    header = {"format": _FORMAT, "config": model.config.to_json(), "notes": json.dumps(notes, sort_keys=True)}
    save_weights(path, model.state_dict(), header)


def find_flow_model(name: str | Path) -> Path:
    """Returns the file of a trained estimator, as `find_weights`; none comes with the package. UsageError if there is none."""
    return find_weights(name, None, _MAKER, "--flow")


def load_flow_model(name: str | Path) -> tuple[FlowNetwork, dict]:
    """Returns a flow network in eval mode and its notes; name: what `find_flow_model` found or takes.

    DataError when the file is damaged. The last two are kept until their files change.
    """
    path = find_flow_model(name)
    return _loaded(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=2)
def _loaded(path: Path, _changed: int) -> tuple[FlowNetwork, dict]:
    tensors, header = load_weights(path, _FORMAT, _MAKER)
    model = FlowNetwork(FlowConfig.from_json(header["config"]))
    load_state(model, tensors, path)
    return model.eval(), json.loads(header["notes"])


@torch.inference_mode()
def trained_flow(points1: Tensor, points2: Tensor, name: str, device: str = "cpu") -> Tensor:
    """Flow (B,N,3) of the estimator `name`, on the inputs' device. Each pair is scaled to diameter 1 for the network, clouds
    of more than 2,048 points are thinned by farthest points and the flow is interpolated; below 16 points, or without
    extent, all shift by the difference of the means."""
    model, _ = load_flow_model(name)
    model = model.to(device)
    out = [_one(model, *(p[None].to(device) for p in pair)) for pair in zip(points1, points2)]
    return torch.cat(out).to(points1.device)


def _one(model: FlowNetwork, points1: Tensor, points2: Tensor) -> Tensor:
    center = points1.mean(1, keepdim=True)
    size = 2 * (points1 - center).square().sum(-1).max().sqrt()
    shift = points2.mean(1, keepdim=True) - center
    if min(points1.shape[1], points2.shape[1]) < _FEWEST or not size > 0:
        return shift.expand_as(points1).clone()
    first, second = ((p - center) / size for p in (points1, points2))
    thin1, thin2 = _thinned(first), _thinned(second)
    flow = model(thin1, thin2)[-1]
    if thin1.shape[1] < first.shape[1]:
        flow = three_nn_interpolate(first, thin1, flow)
    return torch.nan_to_num(flow * size, nan=0.0, posinf=0.0, neginf=0.0)


def _thinned(points: Tensor) -> Tensor:
    return points if points.shape[1] <= _MOST else gather_points(points, fps(points, _MOST))


def augmented(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A training pair (2,N,3) changed at random as FlowStep3D is trained on SAPIEN: both frames scaled by 0.95 to 1.05
    per axis, turned by at most 10 degrees about y, shifted by at most 0.05; the second shifted by at most 0.01 more."""
    angle = rng.uniform(-np.pi / 18, np.pi / 18)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    changed = (points * rng.uniform(0.95, 1.05, 3)) @ turn.T + rng.uniform(-0.05, 0.05, 3)
    changed[1] += rng.uniform(-0.01, 0.01, 3)
    return changed.astype(np.float32)
