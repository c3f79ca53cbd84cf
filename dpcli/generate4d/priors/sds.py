"""Score distillation sampling (SDS, Poole et al. 2022) from Zero123, a view-conditioned diffusion model.

Equation C.11 of the thesis: the gradient w(t) (eps_hat(z_t; reference, camera, t) - eps) flows through the VAE's encoder
into the render. Where the thesis is silent the settings are those of SC4D (Wu et al. 2024): guidance 5,
w(t) = 1 - abar_t, annealed t.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from dpcli.errors import DpcError
from dpcli.generate4d.priors.interface import RelativeCamera
from dpcli.generate4d.priors.zero123_model import Zero123Model, load_zero123
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import Progress, log

_CLIP_MEAN, _CLIP_STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_CHUNK = 8  # frames encoded at a time
_GUIDANCE = 5.0  # of the classifier-free guidance
_T_RANGE = 0.2, 0.8  # shares of the model's steps that are drawn


def camera_scalars(
    cameras: Sequence[RelativeCamera],  # B
    reference_elevation: float | None = None,
) -> torch.Tensor:  # [B, 4]
    """Returns what Zero123 is told of cameras, f32: change of the polar angle (down is positive), sine and cosine of that
    of the azimuth, change of the radius.

    reference_elevation (radians, up is positive): for Stable Zero123, whose fourth scalar is the reference's polar angle
    pi/2 - elevation in place of the radius.
    """
    azimuth, elevation, radius = torch.tensor(cameras, dtype=torch.float64).reshape(-1, 3).unbind(1)
    fourth = radius if reference_elevation is None else torch.full_like(radius, np.pi / 2 - reference_elevation)
    return torch.stack([-elevation, azimuth.sin(), azimuth.cos(), fourth], 1).float()


def annealed_timestep(progress: float, t_range: tuple[float, float], steps: int) -> int:
    """Returns round((1 - progress) steps), clipped to t_range (shares of `steps`): much noise first, details later (SC4D).

    >>> [annealed_timestep(progress, (0.2, 0.8), 1000) for progress in (0.0, 0.5, 1.0)]
    [800, 500, 200]
    """
    low, high = round(t_range[0] * steps), round(t_range[1] * steps)
    return min(max(round((1 - progress) * steps), low), high, steps - 1)


def guided_noise(conditional: torch.Tensor, unconditional: torch.Tensor, scale: float) -> torch.Tensor:
    """Returns the noise of classifier-free guidance (Ho and Salimans 2022); scale 1: the conditional one, 0: the other."""
    return unconditional + scale * (conditional - unconditional)


def sds_loss(latents: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """Returns the SDS loss, a scalar whose derivative by latents (B,...) is gradient / B, the gradient taken as constant.

    gradient: w(t) (eps_hat - eps) (Poole et al. 2022). The value |gradient|^2 / 2B means nothing.

    >>> latents = torch.zeros(2, 3, requires_grad=True)
    >>> sds_loss(latents, torch.ones(2, 3)).backward()
    >>> latents.grad.tolist()
    [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5]]
    """
    target = (latents - gradient).detach()
    return 0.5 * functional.mse_loss(latents, target, reduction="sum") / len(latents)


class ScoreDistillation:
    """Implements `Prior` by score distillation sampling. The model is frozen; its conditioning is computed once for each frame.

    reference_elevation: radians, read by Stable Zero123 only. image_size: pixels the model was trained at.
    """

    def __init__(self, model: Zero123Model, *, reference_elevation: float = 0.0, image_size: int = 256) -> None:
        self.model, self.image_size = model, image_size
        self.reference_elevation = reference_elevation if model.stable else None
        self._embedding = self._reference = torch.empty(0)  # [T, E] and [T, 4, h, w]

    @classmethod
    def load(cls, model: str | None, device: str | torch.device = "auto", **options: Any) -> ScoreDistillation:
        """Returns the prior with the model of `--prior-model` (a folder or a hub id, see `load_zero123`) and these options."""
        device = choose_device(device) if isinstance(device, str) else device
        loaded = load_zero123(model, device)
        if device.type == "cpu":
            log.warn("--prior zero123 on the CPU takes about a minute a step at full size; use a GPU or --prior views")
        return cls(loaded, **options)

    @torch.no_grad()
    def prepare(
        self,
        reference_frames: np.ndarray,  # [T, H, W, 4]
    ) -> None:
        """Encodes the video (u8 RGBA, straight alpha), composed on white, padded to a square, resized to image_size."""
        model, parts = self.model, []
        model.image_encoder.to(model.device)
        with Progress("encode the video", len(reference_frames), "frame") as progress:
            for start in range(0, len(reference_frames), _CHUNK):
                images = self._resized(_on_white(reference_frames[start : start + _CHUNK]).to(model.device))
                latent = model.vae.encode((2 * images - 1).to(model.dtype)).latent_dist.mode()  # unscaled, as trained
                parts.append((self._clip_embedding(images), latent))
                progress.advance(len(images))
        self._embedding, self._reference = (torch.cat(column) for column in zip(*parts, strict=True))
        model.image_encoder.to("cpu")  # not needed any more

    def loss(
        self,
        renders: torch.Tensor,  # [B, H, W, 3]
        cameras: Sequence[RelativeCamera],  # B
        frames: Sequence[int],  # B
        progress: float,
        generator: torch.Generator,
    ) -> torch.Tensor:  # scalar
        """Returns the SDS loss of square renders (RGB in 0..1, on white), mean over views; see `Prior.loss`.

        Its derivative means something, its value doesn't. Views whose gradient overflows float16 add nothing; DpcError when
        all do. ValueError: `prepare` wasn't called, counts differ, renders not square.
        """
        self._check(renders, cameras, frames)
        latents = self._latents(renders)
        timestep = torch.full((len(latents),), annealed_timestep(progress, _T_RANGE, len(self.model.alphas_cumprod)))
        noise = torch.randn(latents.shape, generator=generator, device=generator.device).to(latents.device)
        with torch.no_grad():
            abar = self.model.alphas_cumprod[timestep].to(latents.device)[:, None, None, None]
            noisy = abar.sqrt() * latents + (1 - abar).sqrt() * noise
            gradient = (1 - abar) * (self._noise_prediction(noisy, timestep, cameras, frames) - noise)
        return sds_loss(latents, _finite_views(gradient)).to(renders.device)

    def _check(self, renders: torch.Tensor, cameras: Sequence[RelativeCamera], frames: Sequence[int]) -> None:
        if renders.ndim != 4 or renders.shape[-1] != 3 or renders.shape[1] != renders.shape[2]:
            raise ValueError(f"renders must have shape (B, S, S, 3), but have {tuple(renders.shape)}")
        if not len(renders) == len(cameras) == len(frames) > 0:
            raise ValueError(f"{len(renders)} renders, {len(cameras)} cameras and {len(frames)} frames don't match")
        if not 0 <= min(frames) <= max(frames) < len(self._reference):
            raise ValueError(f"frames {list(frames)}: prepare() was given {len(self._reference)} frames")

    def _latents(self, renders: torch.Tensor) -> torch.Tensor:
        """Returns latents f32 (B,4,h,w), scaled: the encoder's mean, whose spread is negligible beside the noise that is added."""
        images = self._resized(renders.to(self.model.device).float().permute(0, 3, 1, 2))
        if images.requires_grad:
            images.register_hook(_finite_views)  # the encoder's backward pass is in half precision, too
        vae = self.model.vae
        return vae.encode((2 * images - 1).to(self.model.dtype)).latent_dist.mode().float() * vae.config.scaling_factor

    def _noise_prediction(
        self, noisy: torch.Tensor, timestep: torch.Tensor, cameras: Sequence[RelativeCamera], frames: Sequence[int]
    ) -> torch.Tensor:
        """Returns eps_hat f32 (B,4,h,w); without condition both the token and the reference's latent are zero."""
        token = self._tokens(cameras, frames)
        reference = self._reference[list(frames)]
        stacked = torch.cat([noisy.to(self.model.dtype), reference], 1)
        unknown = torch.cat([stacked[:, : noisy.shape[1]], torch.zeros_like(reference)], 1)
        predicted = self.model.unet(
            torch.cat([stacked, unknown]),
            torch.cat([timestep, timestep]).to(noisy.device),
            encoder_hidden_states=torch.cat([token, torch.zeros_like(token)]),
        )
        return guided_noise(*predicted.sample.float().chunk(2), _GUIDANCE)

    def _tokens(self, cameras: Sequence[RelativeCamera], frames: Sequence[int]) -> torch.Tensor:
        """Returns the conditioning tokens (B,1,cross-attention width)."""
        scalars = camera_scalars(cameras, self.reference_elevation).to(self._embedding)
        return self.model.camera_projection(torch.cat([self._embedding[list(frames)], scalars], 1))[:, None]

    def _resized(self, images: torch.Tensor) -> torch.Tensor:
        if images.shape[-2:] == (self.image_size, self.image_size):
            return images
        return functional.interpolate(images, (self.image_size,) * 2, mode="bilinear", antialias=True)

    def _clip_embedding(self, images: torch.Tensor) -> torch.Tensor:
        """Returns CLIP's embedding (B,E) of images (B,3,S,S) in 0..1, brought to CLIP's own size and statistics."""
        encoder = self.model.image_encoder
        size = (encoder.config.image_size,) * 2
        pixels = functional.interpolate(images, size, mode="bicubic", antialias=True).clamp(0, 1)
        mean, std = (pixels.new_tensor(values)[:, None, None] for values in (_CLIP_MEAN, _CLIP_STD))
        return encoder(((pixels - mean) / std).to(self.model.dtype)).image_embeds


def _on_white(frames: np.ndarray) -> torch.Tensor:
    """Returns pictures u8 RGBA (T,H,W,4) as f32 (T,3,S,S) in 0..1 on white, square and centered."""
    rgba = torch.from_numpy(np.ascontiguousarray(frames)).permute(0, 3, 1, 2).float() / 255
    image = rgba[:, :3] * rgba[:, 3:] + (1 - rgba[:, 3:])
    height, width = image.shape[-2:]
    side = max(height, width)
    left, top = (side - width) // 2, (side - height) // 2
    return functional.pad(image, (left, side - width - left, top, side - height - top), value=1.0)


def _finite_views(gradient: torch.Tensor) -> torch.Tensor:
    finite = torch.isfinite(gradient).flatten(1).all(1)
    if not finite.any():
        raise DpcError(
            "--prior zero123: no view's gradient is finite; the model's weights are damaged or overflow float16"
        )
    return torch.where(finite[:, None, None, None], gradient, 0.0)
