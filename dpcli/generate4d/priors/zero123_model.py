"""Zero123's networks from a folder in diffusers' layout or from the Hugging Face hub.

diffusers has no pipeline class of its own for them, so the parts are loaded one by one; code that lies beside the weights
is never run, and nothing is unpickled.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from dpcli.errors import DataError, UsageError, first_line
from dpcli.runtime.torch_files import check_members, load_plain

EXAMPLE_ID = "ashawkey/zero123-xl-diffusers"
CAMERA_SCALARS = 4
_CONFIGS = {
    "unet": "config.json",
    "vae": "config.json",
    "image_encoder": "config.json",
    "clip_camera_projection": None,  # its sizes follow from its weights
    "scheduler": "scheduler_config.json",
}
_WEIGHT_NAME = re.compile(r"(?:diffusion_pytorch_model|pytorch_model|model)(?:\.([\w-]+))?\.(safetensors|bin)")
_VARIANTS = {True: ("fp16", "fp16_ema", "", "ema"), False: ("", "ema", "fp16", "fp16_ema")}  # by half precision


@dataclass
class Zero123Model:
    """Holds the frozen networks on one device in one precision, and the noise schedule."""

    unet: torch.nn.Module  # UNet2DConditionModel: noise from 4 noisy + 4 reference latent channels and one token
    vae: torch.nn.Module  # AutoencoderKL, encoder only
    image_encoder: torch.nn.Module  # CLIPVisionModelWithProjection
    camera_projection: torch.nn.Linear  # CLIP embedding ++ camera scalars -> token
    alphas_cumprod: torch.Tensor  # f32 (steps), on the CPU
    stable: bool  # Stable Zero123: the fourth camera scalar is the reference's polar angle

    @property
    def device(self) -> torch.device:
        """Returns the device of all networks."""
        return self.camera_projection.weight.device

    @property
    def dtype(self) -> torch.dtype:
        """Returns the precision of all networks."""
        return self.camera_projection.weight.dtype


def load_zero123(
    model: str | None, device: torch.device, *, half: bool | None = None, stable: bool | None = None
) -> Zero123Model:
    """Returns Zero123 or Stable Zero123 from `--prior-model`: a folder, or the id of a hub repository.

    half: float16; default: on CUDA only. stable: which camera scalars the model takes; default: Stable Zero123's when
    its name says "stable". The hub is asked only for an id that is not in its local cache. UsageError: no model named,
    diffusers or transformers not installed. DataError: a part is absent, not whole or of another architecture.
    """
    if not model:
        raise UsageError(
            f"--prior zero123 needs --prior-model: a folder with the weights or a hub id, say {EXAMPLE_ID}"
        )
    _require_libraries()
    half = device.type == "cuda" if half is None else half
    folder = _find_folder(model, half)
    dtype = torch.float16 if half else torch.float32
    loaded = Zero123Model(
        unet=_network("diffusers", "UNet2DConditionModel", folder / "unet", half, torch_dtype=dtype),
        vae=_network("diffusers", "AutoencoderKL", folder / "vae", half, torch_dtype=dtype),
        image_encoder=_network("transformers", "CLIPVisionModelWithProjection", folder / "image_encoder", half),
        camera_projection=_camera_projection(folder / "clip_camera_projection", half),
        alphas_cumprod=_noise_schedule(folder / "scheduler"),
        stable="stable" in Path(model).resolve().name.lower() if stable is None else stable,
    )
    _check_sizes(loaded, folder)
    loaded.vae.decoder = loaded.vae.post_quant_conv = None  # never used here: 0.2 GB in float32
    for network in (loaded.unet, loaded.vae, loaded.image_encoder, loaded.camera_projection):
        network.requires_grad_(False).eval().to(device, dtype)
    return loaded


def weight_file(names: Iterable[str], half: bool) -> tuple[str, str, bool] | None:
    """Returns name, variant and whether it is safetensors, of the weights to take among a folder's files; None without any.

    Half precision prefers the fp16 files, otherwise plain ones; then safetensors before .bin.
    """
    found = []
    for name in names:
        if match := _WEIGHT_NAME.fullmatch(name):
            variant, safe = match[1] or "", match[2] == "safetensors"
            if variant in _VARIANTS[half]:
                found.append((_VARIANTS[half].index(variant), not safe, name, variant))
    if not found:
        return None
    _, pickled, name, variant = min(found)
    return name, variant, not pickled


def missing_parts(files: Iterable[str], half: bool) -> list[str]:
    """Returns what a model of these files (paths in its folder, with /) lacks, such as `vae/config.json`, `unet weights`."""
    files = set(files)
    missing = [f"{part}/{config}" for part, config in _CONFIGS.items() if config and f"{part}/{config}" not in files]
    for part in _CONFIGS:
        inside = [name.removeprefix(f"{part}/") for name in files if name.startswith(f"{part}/")]
        if part != "scheduler" and weight_file(inside, half) is None:
            missing.append(f"{part} weights (.safetensors or .bin)")
    return missing


def _require_libraries() -> None:
    try:
        import diffusers
        import transformers
    except ImportError as error:
        raise UsageError(
            f"--prior zero123 needs diffusers and transformers ({error}): pip install 'dpc-toolkit[zero123]'"
        ) from None
    for library in (diffusers, transformers):
        library.utils.logging.set_verbosity_error()
        library.utils.logging.disable_progress_bar()


def _find_folder(model: str, half: bool) -> Path:
    folder = Path(model).expanduser()
    if not folder.is_dir():
        if not re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", model):
            raise DataError(f"--prior-model {model}: no such folder, and no hub id (those read like {EXAMPLE_ID})")
        folder = _hub_folder(model, half)
    if missing := missing_parts(_files_of(folder), half):
        raise DataError(
            f"--prior-model {folder}: lacks {', '.join(missing)}; expected the subfolders {', '.join(_CONFIGS)}"
            f" as in {EXAMPLE_ID} on the Hugging Face hub"
        )
    return folder


def _files_of(folder: Path) -> list[str]:
    return [path.relative_to(folder).as_posix() for path in folder.glob("*/*") if path.is_file()]


def _hub_folder(model: str, half: bool) -> Path:
    """Returns the cached copy of a hub repository, whose needed files are fetched first where they aren't there."""
    import huggingface_hub as hub

    try:
        cached = Path(hub.snapshot_download(model, local_files_only=True))
        if not missing_parts(_files_of(cached), half):
            return cached
    except Exception:  # not in the cache; which class says so depends on the library's version
        pass
    try:
        return Path(hub.snapshot_download(model, allow_patterns=_needed(hub.HfApi().list_repo_files(model), half)))
    except Exception as error:  # likewise: its own classes, or those of one of two HTTP libraries
        raise DataError(
            f"--prior-model {model}: no such folder, and it couldn't be fetched from the hub ({first_line(error)}). On a machine"
            f" with network: `hf download {model} --local-dir FOLDER`; then --prior-model FOLDER"
        ) from None


def _needed(files: list[str], half: bool) -> list[str]:
    """Returns the files of a repository to fetch: the configurations and one variant of each network's weights."""
    wanted = []
    for part, config in _CONFIGS.items():
        inside = [name.removeprefix(f"{part}/") for name in files if name.startswith(f"{part}/")]
        chosen = weight_file(inside, half)
        wanted += [f"{part}/{name}" for name in (config, chosen and chosen[0]) if name]
    return wanted


def _network(library: str, name: str, folder: Path, half: bool, **options: Any) -> torch.nn.Module:
    import importlib

    file, variant, safe = weight_file([path.name for path in folder.iterdir()], half)
    options |= {"variant": variant or None, "use_safetensors": safe, "local_files_only": True}
    if library == "diffusers":
        options["low_cpu_mem_usage"] = False  # True needs another package, accelerate
    try:
        if not safe:
            check_members(folder / file)
        network, report = getattr(importlib.import_module(library), name).from_pretrained(
            folder, output_loading_info=True, **options
        )
    except Exception as error:  # damaged JSON, cut files, wrong shapes: each has its own class in each library
        raise DataError(f"{folder / file}: can't be loaded as {name} ({first_line(error)})") from None
    if absent := sorted(report["missing_keys"]):  # the libraries fill them with random numbers
        raise DataError(f"{folder / file}: {len(absent)} of {name}'s tensors are absent, {absent[0]!r} for one")
    return network


def _camera_projection(folder: Path, half: bool) -> torch.nn.Linear:
    from safetensors.torch import load_file

    file, _, safe = weight_file([path.name for path in folder.iterdir()], half)
    try:
        path = folder / file
        tensors = load_file(path) if safe else load_plain(path)
        weight, bias = tensors["proj.weight"], tensors["proj.bias"]
    except DataError:
        raise
    except Exception as error:  # as above
        raise DataError(f"{folder / file}: expected tensors proj.weight and proj.bias ({first_line(error)})") from None
    if weight.ndim != 2 or bias.shape != weight.shape[:1]:
        raise DataError(
            f"{folder / file}: proj.weight {tuple(weight.shape)} and proj.bias {tuple(bias.shape)} don't fit"
        )
    projection = torch.nn.utils.skip_init(torch.nn.Linear, weight.shape[1], weight.shape[0])
    projection.load_state_dict({"weight": weight.float(), "bias": bias.float()})
    return projection


def _noise_schedule(folder: Path) -> torch.Tensor:
    from diffusers import DDIMScheduler

    path = folder / "scheduler_config.json"
    try:
        predicts = json.loads(path.read_text()).get("prediction_type", "epsilon")
        schedule = DDIMScheduler.from_pretrained(folder, local_files_only=True).alphas_cumprod
    except Exception as error:
        raise DataError(f"{path}: not a scheduler's configuration ({first_line(error)})") from None
    if predicts != "epsilon":
        raise DataError(f"{path}: prediction_type {predicts!r}, expected 'epsilon', which Zero123 predicts")
    return schedule.float()


def _check_sizes(model: Zero123Model, folder: Path) -> None:
    latent, embedding = model.vae.config.latent_channels, model.image_encoder.config.projection_dim
    found = {
        "unet/config.json in_channels": (model.unet.config.in_channels, 2 * latent),
        "unet/config.json out_channels": (model.unet.config.out_channels, latent),
        "clip_camera_projection inputs": (model.camera_projection.in_features, embedding + CAMERA_SCALARS),
        "clip_camera_projection outputs": (model.camera_projection.out_features, model.unet.config.cross_attention_dim),
    }
    for what, (value, expected) in found.items():
        if value != expected:
            raise DataError(
                f"--prior-model {folder}: {what} is {value}, expected {expected}; this is not a Zero123 model"
            )
