"""Weights on disk: one safetensors file with the configuration and class names in its header. Nothing is unpickled."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from dpcli import __version__
from dpcli.classify.config import KinetConfig
from dpcli.classify.kinet import Kinet
from dpcli.errors import DataError, UsageError


@dataclass
class ModelInfo:
    """What a model file says of itself beside the weights."""

    config: KinetConfig
    class_names: list[str]
    timing: str = "clips"
    notes: dict = field(default_factory=dict)


def save_model(path: Path, model: nn.Module, info: ModelInfo) -> None:
    """Write beside the target, then rename; weights as float32."""
    from safetensors.torch import save_file

    tensors = {name: value.detach().cpu().contiguous() for name, value in model.state_dict().items()}
    header = {
        "format": "dpc-kinet-1", "version": __version__, "config": info.config.to_json(), "timing": info.timing,
        "class_names": json.dumps(info.class_names), "notes": json.dumps(info.notes, sort_keys=True),
    }  # fmt: skip
    part = path.with_name(f".{path.name}.part")
    save_file(tensors, part, header)
    umask = os.umask(0)
    os.umask(umask)
    part.chmod(0o666 & ~umask)  # the library writes files that only their owner can read
    os.replace(part, path)


SHIPPED = Path(__file__).with_name("weights")


def shipped_models() -> list[str]:
    """Names of the models that come with the package; each has a card `NAME.md` beside it."""
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def find_model(name: str) -> Path:
    """A model's file: a path, `best.safetensors` of a training folder, or a shipped name. UsageError when there is none."""
    path = Path(name)
    if path.is_dir():
        path = path / "best.safetensors"
    if not path.is_file() and name in shipped_models():
        return SHIPPED / f"{name}.safetensors"
    if not path.is_file():
        raise UsageError(
            f"--model {name}: no such file; give a .safetensors file, a folder made by `dpc classify train`"
            f" or a shipped model ({', '.join(shipped_models()) or 'none in this installation'})"
        )
    return path


def load_model(name: str) -> tuple[Kinet, ModelInfo]:
    """A Kinet in eval mode. DataError when the file is not one of ours or its weights don't fit its configuration."""
    from safetensors import SafetensorError, safe_open

    path = find_model(name)
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}
    except (SafetensorError, OSError) as error:
        raise DataError(f"{path}: not a complete safetensors file ({error})") from None
    if header.get("format") != "dpc-kinet-1":
        raise DataError(f"{path}: format {header.get('format')!r}, expected a Kinet written by `dpc classify train`")
    config = KinetConfig.from_json(header["config"])
    model = Kinet(config)
    try:
        model.load_state_dict(tensors)
    except RuntimeError as error:
        raise DataError(f"{path}: weights don't fit the configuration: {str(error).splitlines()[1].strip()}") from None
    if not all(torch.isfinite(value).all() for value in tensors.values()):
        raise DataError(f"{path}: holds NaN or infinite weights; train again or use another checkpoint")
    info = ModelInfo(config, json.loads(header["class_names"]), header["timing"], json.loads(header["notes"]))
    return model.eval(), info
