"""A CUDA device that isn't there: its tensors claim to lie on it, are computed on the CPU, and refuse what a GPU refuses.

`with pretend_card(): ...` makes torch tell of one card. What is brought there (`.to("cuda")`, `device="cuda"`) is a
`Resident`; an operation that meets a resident and a CPU tensor fails as on a GPU, and so do `.numpy()` and a generator of
the other device. So the lines that only a GPU takes run on any machine, and their numbers can be compared. It can't
show CUDA kernels, autocast's products, streams, speed or memory; and backwards, where torch makes zeros in C++ for
what it believes to be CPU tensors, devices aren't compared.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map_only

CARD, HOST = torch.device("cuda", 0), torch.device("cpu")
_ATEN = torch.ops.aten
_INDEXED = {_ATEN.index.Tensor, _ATEN.index_put.default, _ATEN.index_put_.default, _ATEN._index_put_impl_.default}


class Resident(Tensor):
    """A tensor of the card. held: the CPU tensor that does its work. C++ sees a CPU tensor, so autograd needs no card."""

    held: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held: Tensor) -> Resident:
        shell = torch.Tensor._make_wrapper_subclass(
            cls, held.size(), held.stride(), held.storage_offset(), dtype=held.dtype, requires_grad=held.requires_grad
        )
        shell.held = held
        return shell

    @property
    def device(self) -> torch.device:
        return CARD

    @property
    def is_cuda(self) -> bool:
        return True

    @property
    def is_cpu(self) -> bool:
        return False

    def __tensor_flatten__(self):  # so that nn.Module.to exchanges whole parameters and not only their data
        return ["held"], None

    @staticmethod
    def __tensor_unflatten__(inner, meta, outer_size, outer_stride) -> Resident:
        return Resident(inner["held"])

    def __repr__(self) -> str:
        return f"Resident({self.held!r})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        _refuse_strangers(func, args, kwargs)
        plain_args, plain_kwargs = tree_map_only(Resident, lambda one: one.held, (args, kwargs))
        out = func(*plain_args, **plain_kwargs)
        if func is _ATEN._local_scalar_dense.default:
            return out
        out = tree_map_only(Tensor, lambda one: one if isinstance(one, Resident) else Resident(one), out)
        return return_and_correct_aliasing(func, args, kwargs, out)


def _refuse_strangers(func, args, kwargs) -> None:
    """RuntimeError where tensors of both devices meet, but for what a GPU allows: copies, indices, single numbers."""
    backwards = torch._C._current_graph_task_id() != -1
    if func is _ATEN.copy_.default or backwards:
        return
    met = tree_flatten((args, kwargs))[0]
    if func in _INDEXED:
        if not isinstance(args[0], Resident) and any(isinstance(one, Resident) for one in args[1]):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        met = [args[0], *args[2:3]]
    strangers = [one for one in met if isinstance(one, Tensor) and not isinstance(one, Resident) and one.dim()]
    if strangers and any(isinstance(one, Resident) for one in met):
        raise RuntimeError(
            "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!"
            f" ({func} met a CPU tensor of shape {tuple(strangers[0].shape)})"
        )


class _ToCard(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor: Tensor) -> Tensor:
        return Resident(tensor.detach().clone())

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        return gradient.held.clone() if isinstance(gradient, Resident) else gradient


class _FromCard(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tensor: Resident) -> Tensor:
        return tensor.held.detach().clone()

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        return Resident(gradient.clone())


def _brought(tensor: Tensor, device: torch.device | None) -> Tensor:
    """The tensor on that device; itself if it is there or none is asked."""
    if device is None or isinstance(tensor, Resident) == (device.type == "cuda"):
        return tensor
    return _ToCard.apply(tensor) if device.type == "cuda" else _FromCard.apply(tensor)


def _as_device(value: Any) -> torch.device | None:
    return None if value is None else torch.device("cuda", value) if isinstance(value, int) else torch.device(value)


class _Card(TorchFunctionMode):
    """Takes `device=` away from a call and brings its result there, before torch looks for a driver."""

    def __torch_function__(self, func: Callable, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if func in _OWN_WAY:
            return _OWN_WAY[func](func, args, kwargs)
        device, generator = _as_device(kwargs.pop("device", None)), kwargs.get("generator")
        if device is not None and generator is not None and generator.device.type != device.type:
            raise RuntimeError(
                f"Expected a '{device.type}' device type for generator but found '{generator.device.type}'"
            )
        return tree_map_only(Tensor, lambda one: _brought(one, device), func(*args, **kwargs))


def _to(func, args, kwargs):
    tensor, rest = args[0], list(args[1:])
    kwargs.pop("non_blocking", None)
    like = kwargs.pop("other", None)
    if rest and isinstance(rest[0], Tensor):
        like = rest.pop(0)
    device, dtype = (
        (kwargs.pop("device", None), kwargs.pop("dtype", None)) if like is None else (like.device, like.dtype)
    )
    if rest and not isinstance(rest[0], torch.dtype):
        device = rest.pop(0)
    if rest:
        dtype = rest.pop(0)
    return func(_brought(tensor, _as_device(device)), dtype or tensor.dtype, **kwargs)


def _numpy(func, args, kwargs):
    if isinstance(args[0], Resident):
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")
    return func(*args, **kwargs)


def _new_tensor(func, args, kwargs):
    """Filled by C++ for what it takes for a CPU tensor."""
    device = _as_device(kwargs.pop("device", args[0].device))
    return _brought(func(_brought(args[0].detach(), HOST), *args[1:], **kwargs), device)


def _one_hot(func, args, kwargs):
    """Composed in C++ of the labels and a fresh CPU tensor."""
    return _brought(func(_brought(args[0], HOST), *args[1:], **kwargs), args[0].device)


def _embedding_bag(func, args, kwargs):
    """Where bags have equal size, torch makes their starts on the device that they name."""
    bags, weight = args
    if bags.dim() == 2 and isinstance(bags, Resident):
        kwargs["offsets"] = Resident(torch.arange(0, bags.numel(), bags.shape[1]))
        kwargs["per_sample_weights"] = kwargs["per_sample_weights"].reshape(-1)
        bags = bags.reshape(-1)
    return func(bags, weight, **kwargs)


_OWN_WAY = {
    Tensor.to: _to,
    Tensor.cpu: lambda func, args, kwargs: _brought(args[0], HOST),
    Tensor.cuda: lambda func, args, kwargs: _brought(args[0], CARD),
    Tensor.numpy: _numpy,
    Tensor.__array__: _numpy,
    Tensor.new_tensor: _new_tensor,
    functional.one_hot: _one_hot,
    functional.embedding_bag: _embedding_bag,
    # asked by nn.Module.to: whether a parameter may keep its shell and get other data
    torch._has_compatible_shallow_copy_type: lambda func, args, kwargs: (
        isinstance(args[0], Resident) == isinstance(args[1], Resident)
    ),
}
_TOLD = {
    "is_available": lambda: True,
    "device_count": lambda: 1,
    "current_device": lambda: 0,
    "get_device_name": lambda device=None: "pretend card",
    "is_bf16_supported": lambda including_emulation=True: True,
    "max_memory_allocated": lambda device=None: 0,
    **{name: lambda *_: None for name in ("set_device", "synchronize", "reset_peak_memory_stats", "empty_cache")},
    **{name: lambda seed: None for name in ("manual_seed", "manual_seed_all")},
}


_ASKS_A_DRIVER = [
    name for name in dir(torch.optim.Optimizer) if name.endswith("_graph_capture_health_check")
]  # CUDA builds


def _enter_no_grad(self) -> None:
    self.instead = torch.no_grad()
    self.instead.__enter__()


def _leave_no_grad(self, *raised) -> None:
    self.instead.__exit__(*raised)


@contextlib.contextmanager
def pretend_card() -> Iterator[None]:
    """A block, and the threads it starts, in which torch has one card."""
    plain_run, plain_save = threading.Thread.run, torch.save

    def run(thread: threading.Thread) -> None:  # modes are a thread's own
        with _Card():
            plain_run(thread)

    def save(value: Any, *args, **kwargs) -> None:
        plain_save(tree_map_only(Resident, lambda one: one.held.detach(), value), *args, **kwargs)

    with contextlib.ExitStack() as stack:
        for where, name, other in (
            *((torch.cuda, name, told) for name, told in _TOLD.items()),
            (threading.Thread, "run", run),
            (torch, "save", save),
            *((torch.optim.Optimizer, name, lambda self: None) for name in _ASKS_A_DRIVER),
            (torch.inference_mode, "__enter__", _enter_no_grad),  # its tensors have no version counter, shells need one
            (torch.inference_mode, "__exit__", _leave_no_grad),
        ):
            stack.enter_context(mock.patch.object(where, name, other))
        stack.enter_context(_Card())
        yield
