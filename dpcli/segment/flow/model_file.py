"""The weights file of a flow network, and the network's answer for clouds of any size and unit of length."""

from __future__ import annotations

import functools
from copy import deepcopy
from pathlib import Path

import torch
from torch import Tensor

from dpcli.ops import fps, gather_points, three_nn_interpolate
from dpcli.runtime.weights import find_weights, load_network, network_header, save_weights
from dpcli.segment.flow.config import FlowConfig
from dpcli.segment.flow.flowstep3d import FlowStep3D

_FORMAT, _MAKER = "dpc-flow-1", "dpc segment flow"
_MOST, _FEWEST = 2048, 16  # points the network sees at once; fewer than the latter move as one


def save_flow_model(path: Path, model: FlowStep3D, notes: dict) -> None:
    """Writes the weights as float32, with the configuration and notes (a small JSON object) in the header."""
    save_weights(path, model.state_dict(), network_header(_FORMAT, model.config, notes))


def find_flow_model(name: str | Path) -> Path:
    """Returns the weights file that a name means, as `find_weights`; none comes with the package. Raises DataError."""
    return find_weights(name, None, _MAKER, "--flow")


def load_flow_model(name: str | Path) -> tuple[FlowStep3D, dict]:
    """Returns a flow network in eval mode and its notes; the last two are kept until their files change.

    Raises DataError for a damaged file.
    """
    path = find_flow_model(name)
    return _read_flow_model(path, path.stat().st_mtime_ns)


@functools.lru_cache(maxsize=2)
def _read_flow_model(path: Path, _changed: int) -> tuple[FlowStep3D, dict]:
    """Returns the network and notes of a file; `_changed`, its time of change, is there for the cache."""
    return load_network(path, _FORMAT, _MAKER, FlowConfig, FlowStep3D)


@functools.lru_cache(maxsize=2)
def _network_on(path: Path, changed: int, device: str) -> FlowStep3D:
    """Returns the network of a file on a device: one of its own, since threads that moved the same one at once would meet."""
    return deepcopy(_read_flow_model(path, changed)[0]).to(device)


@torch.inference_mode()
def trained_flow(points1: Tensor, points2: Tensor, name: str, device: str = "cpu") -> Tensor:
    """Returns the flow (B,N,3) of clouds (B,N,3), (B,M,3) by the trained network `name`, on the inputs' device.

    Each pair is scaled to diameter 1 for the network, clouds of more than 2,048 points are thinned by farthest points and
    the flow is interpolated; below 16 points, or without extent, all shift by the difference of the means.
    """
    path = find_flow_model(name)
    model = _network_on(path, path.stat().st_mtime_ns, device)
    out = [_estimate_pair(model, *(p[None].to(device) for p in pair)) for pair in zip(points1, points2)]
    return torch.cat(out).to(points1.device)


def _estimate_pair(model: FlowStep3D, points1: Tensor, points2: Tensor) -> Tensor:
    """Returns the flow (1,N,3) of one pair of clouds (1,N,3), (1,M,3)."""
    center = points1.mean(1, keepdim=True)
    size = 2 * (points1 - center).square().sum(-1).max().sqrt()
    shift = points2.mean(1, keepdim=True) - center
    if min(points1.shape[1], points2.shape[1]) < _FEWEST or not size > 0:
        return shift.expand_as(points1).clone()
    first, second = ((p - center) / size for p in (points1, points2))
    thin1, thin2 = _thin(first), _thin(second)
    flow = model(thin1, thin2)[-1]
    if thin1.shape[1] < first.shape[1]:
        flow = three_nn_interpolate(first, thin1, flow)
    return torch.nan_to_num(flow * size, nan=0.0, posinf=0.0, neginf=0.0)


def _thin(points: Tensor) -> Tensor:
    """Returns at most 2,048 farthest points of a cloud (1,N,3)."""
    return points if points.shape[1] <= _MOST else gather_points(points, fps(points, _MOST))
