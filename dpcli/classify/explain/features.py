"""The places where explanations look into a network: the features of a stage's centroids, and the vector before the last layer.

Forward hooks find both in any backbone, so none has to offer more than the three methods of `network/backbones/interface.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dpcli.classify.network.kinet import Kinet
from dpcli.errors import UsageError

_TINY = 1e-30  # a following ReLU passes the gradient of this, not that of 0


@dataclass
class Layer:
    """Holds the features (M,C) of the centroids of one stage of one clip, the centroids' places (M,3) and frames (M) in the network's
    coordinates, and the gradient (M,C) of a class's logit with respect to the features, where one was asked for."""

    centers: Tensor
    times: Tensor
    values: Tensor
    gradient: Tensor | None = None


@dataclass
class _Call:
    """Names the n-th call of a module in a pass."""

    module: nn.Module
    number: int


def stage_layer(model: Kinet, points: Tensor, stream: str, stage: int | None, target: int | None) -> Layer:
    """Returns the features of a stage (0 the first, None the last) of stream `static` or `dynamic` on one clip (1,T,P,3).

    Without `target`: the last layer's activations before pooling, at their largest over each neighborhood; in the dynamic
    stream the merged feature after that layer's fit, which has one vector a centroid. With `target`, a class: the features
    after pooling and the gradient of that class's logit. The network must be in eval mode. Raises UsageError when it lacks the stage.
    """
    with torch.no_grad():
        groups = model.group(points)
        own = stream == "static" and model.config.own_static_groups  # they come first, as many as the dynamic stream's
        stages, _ = model.static.taps(groups[: len(groups) // 2] if own else groups)
    count = len(stages)
    chosen = count - 1 if stage is None else stage
    if not 0 <= chosen < count:
        raise UsageError(f"stage = {chosen + 1}: this network has {count} stages, expected 1..{count}")
    grouping = stages[chosen].grouping
    where = grouping.centers[0].detach(), grouping.center_times[0].detach()
    if stream == "static" and target is None:
        return Layer(*where, stages[chosen].activations[-1].amax(2)[0])
    run = (lambda: model.static(groups)) if stream == "static" else (lambda: model.dynamic_logits(points))
    sizes = [stage.grouping.centers.shape[1] for stage in stages]
    if stream == "dynamic" and chosen < count - 1:
        values, gradient = _merged(
            model, run, sum(len(s.activations) for s in stages[: chosen + 1]) - 1, chosen, target
        )
    else:
        if chosen < count - 1 and sizes[chosen] in sizes[chosen + 1 :]:
            raise UsageError(
                f"stage = {chosen + 1}: later stages have as many centroids; only stage = {count} can be explained"
            )
        values, gradient = _seen(_last_call(getattr(model, stream), run, sizes[chosen]), run, target)
    shape = (sizes[chosen], -1)
    return Layer(*where, values.reshape(shape), None if gradient is None else gradient.reshape(shape))


def _last_call(network: nn.Module, run: Callable[[], Tensor], rows: int) -> _Call:
    """Returns the last module whose output has one feature for each of the centroids: (1,M,C), or else (M,C)."""
    calls: dict[nn.Module, int] = {}
    found: dict[int, _Call] = {}

    def note(module: nn.Module, _: object, output: object) -> None:
        """Notes each call whose output has the wanted shape."""
        calls[module] = calls.get(module, -1) + 1
        if isinstance(output, Tensor) and output.is_floating_point() and output.shape[:-1] in ((1, rows), (rows,)):
            found[output.dim()] = _Call(module, calls[module])

    with _hooked(network.modules(), note), torch.no_grad():
        run()
    if not found:
        raise UsageError(f"no layer of this network gives one feature for each of its {rows} centroids")
    return found[max(found)]


def _seen(
    call: _Call, run: Callable[[], Tensor], target: int | None, make: Callable[[Tensor], Tensor] = lambda output: output
) -> tuple[Tensor, Tensor | None]:
    """Returns the output of a call (after `make`), and with `target` the gradient of that logit with respect to it."""
    seen: list[Tensor] = []
    count = -1

    def note(_: nn.Module, __: object, output: Tensor) -> Tensor | None:
        """Replaces the output of the wanted call by a copy that gradients reach."""
        nonlocal count
        count += 1
        if count != call.number:
            return None
        seen.append(make(output.detach()).requires_grad_(target is not None))
        return seen[0].clone() if target is not None else None  # a copy, because what follows may work in place

    with _hooked([call.module], note), torch.set_grad_enabled(target is not None):
        logits = run()
    if target is None:
        return seen[0], None
    (gradient,) = torch.autograd.grad(logits[0, target], seen[0], allow_unused=True)
    return seen[0].detach(), torch.zeros_like(seen[0]) if gradient is None else gradient


def _merged(
    model: Kinet, run: Callable[[], Tensor], level: int, stage: int, target: int | None
) -> tuple[Tensor, Tensor | None]:
    """Returns a feature inside the merge, after the ReLU of level `level`, the last of `stage`."""
    merge = model.dynamic.merge
    if hasattr(merge, "norms"):
        return _seen(_Call(merge.norms[level], 0), run, target, lambda output: output.clamp(min=_TINY))
    if target is not None or not hasattr(merge, "current"):
        raise UsageError(
            f"stage = {stage + 1}: the dynamic stream of this network can be explained at its last stage only"
        )
    current, last = (_seen(_Call(m, 0), run, None)[0] for m in (merge.current[-1][stage], merge.last[stage]))
    return torch.relu(current) + torch.relu(last), None


@contextmanager
def _hooked(modules, note: Callable) -> Iterator[None]:
    handles = [module.register_forward_hook(note) for module in modules]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


class ClipVectors:
    """Finds the vectors that the last layers of both streams read: `vectors(points)` -> {stream: (B,D)} for clips (B,T,P,3).

    The last layer is the module whose output is the stream's logits. Raises UsageError when there is none.
    """

    def __init__(self, model: Kinet, points: Tensor) -> None:
        self.model = model
        candidates: list[tuple[nn.Module, Tensor]] = []

        def note(module: nn.Module, inputs: tuple, output: object) -> None:
            """Notes each call that has one tensor for input and one for output."""
            if isinstance(output, Tensor) and len(inputs) == 1 and isinstance(inputs[0], Tensor):
                candidates.append((module, output))

        with _hooked(model.modules(), note), torch.no_grad():
            logits = dict(zip(("static", "dynamic"), model(points)))
        self.layers: dict[str, nn.Module] = {}
        for stream, wanted in logits.items():
            own = set(getattr(model, stream).modules())
            found = [m for m, out in candidates if m in own and out.shape == wanted.shape and torch.equal(out, wanted)]
            if not found:
                raise UsageError(
                    f"the {stream} stream's logits don't come from a layer; its network ends with no nn.Linear"
                )
            self.layers[stream] = found[0]

    @torch.no_grad()
    def vectors(self, points: Tensor) -> dict[str, Tensor]:
        """Returns the vectors {stream: (B,D)} of clips (B,T,P,3)."""
        seen: dict[nn.Module, Tensor] = {}

        def note(module: nn.Module, inputs: tuple, _: Tensor) -> None:
            """Notes what the last layer reads."""
            seen[module] = inputs[0].flatten(1)

        with _hooked(set(self.layers.values()), note):
            self.model(points)
        return {stream: seen[layer] for stream, layer in self.layers.items()}
