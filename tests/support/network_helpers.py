"""Networks with weights that NumPy's generators give, so that golden values hold on any machine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from dpcli.runtime.seeds import generator

Vector = Callable[[np.random.Generator, str, tuple[int, ...]], np.ndarray]  # of (rng, name, shape)


def seeded_state(module: torch.nn.Module, stream: int, vector: Vector) -> dict[str, torch.Tensor]:
    """One generator (0, stream, index) a tensor; matrices keep the size of activations, `vector` draws all else."""
    state = {}
    for index, (name, value) in enumerate(module.state_dict().items()):
        rng, shape = generator(0, stream, index), tuple(value.shape)
        if value.dim() > 1:
            found = rng.standard_normal(shape, np.float32) * (2 / np.prod(shape[1:])) ** 0.5
        else:
            found = vector(rng, name, shape)
        state[name] = torch.tensor(0) if name.endswith("tracked") else torch.from_numpy(np.asarray(found, np.float32))
    return state


def seeded(make: Callable[[], torch.nn.Module], stream: int, vector: Vector) -> torch.nn.Module:
    """A network with `seeded_state`; PyTorch's own random weights are never drawn, which would take longer."""
    with torch.device("meta"):
        module = make()
    module.load_state_dict(seeded_state(module, stream, vector), assign=True)
    return module
