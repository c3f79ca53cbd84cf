"""The canonical Gaussians: what is learned of each, and how their number grows and shrinks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.generate4d.config import FitConfig
from dpcli.generate4d.scene.control_points import mean_neighbor_distance
from dpcli.generate4d.scene.quaternion import normalize, rotate

SH0 = 0.28209479177387814  # of the constant spherical harmonic
NAMES = ("mean", "log_scale", "quaternion", "opacity_logit", "color")


class CanonicalGaussians(nn.Module):
    """Parameters of N Gaussians: mean (N,3), log_scale (N,3), quaternion (N,4), opacity_logit (N,), color (N,3) in 0..1.

    `anchor` (N,3) remembers where each one (or its ancestor) was put at the start; it isn't learned.
    """

    def __init__(self, mean: Tensor, color: Tensor, opacity: float = 0.5, most_scale: float = 0.05) -> None:
        super().__init__()
        scale = mean_neighbor_distance(mean, 3).clamp(1e-4, most_scale)
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(mean), 1)
        self.mean = nn.Parameter(mean.clone())
        self.log_scale = nn.Parameter(scale.log()[:, None].repeat(1, 3))
        self.quaternion = nn.Parameter(identity)
        self.opacity_logit = nn.Parameter(torch.full((len(mean),), opacity).logit())
        self.color = nn.Parameter(color.clone())
        self.register_buffer("anchor", mean.clone())
        self.register_buffer("gradient", torch.zeros(len(mean)))
        self.register_buffer("seen", torch.zeros(len(mean)))

    def __len__(self) -> int:
        return len(self.mean)

    def parameter_groups(self, config: FitConfig) -> list[dict]:
        """Parameter groups for Adam, named, with their first rates."""
        rates = (config.rate_mean[0], config.rate_scale, config.rate_quaternion, config.rate_opacity, config.rate_color)
        return [{"params": [getattr(self, name)], "lr": rate, "name": name} for name, rate in zip(NAMES, rates)]

    @torch.no_grad()
    def add_screen_gradient(self, gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Add up screen gradients (C,N,2) of Gaussians that are in a picture, in units of half its width and height."""
        seen = (radii > 0).reshape(*gradient.shape[:2], -1).any(-1)
        size = (gradient * gradient.new_tensor([width / 2, height / 2])).norm(dim=-1)
        self.gradient += (size * seen).sum(0)
        self.seen += seen.sum(0)

    @torch.no_grad()
    def densify_and_prune(
        self, optimizer: torch.optim.Optimizer, config: FitConfig, rng: torch.Generator, grow: bool
    ) -> None:
        """Copy or split the Gaussians with the largest mean screen gradient, then drop the transparent ones.

        Small ones are cloned, large ones (above the median size) split in two of 1/1.6 the size, as 3D Gaussian splatting
        does; Adam's memory of a copy starts at zero.
        """
        mean_gradient = self.gradient / self.seen.clamp(min=1)
        keep = self.opacity_logit.sigmoid() >= config.prune_opacity
        chosen = torch.zeros_like(keep)
        room = min(int(config.grow_share * len(self)), config.most_gaussians - int(keep.sum()))
        if grow and room > 0:
            score = torch.where(keep, mean_gradient, torch.zeros_like(mean_gradient))
            best = score.topk(min(room, len(score)), sorted=True)
            chosen[best.indices[best.values > config.grow_threshold]] = True
        if not keep.any():
            keep[self.opacity_logit.argmax()] = True
        old, new = keep.nonzero()[:, 0], chosen.nonzero()[:, 0]
        size = self.log_scale.max(1).values
        split = new[size[new] > size.median()]
        offset = torch.randn(len(new), 3, generator=rng).to(self.mean.device) * self.log_scale[new].exp()
        offset = rotate(normalize(self.quaternion[new]), offset)
        self._keep_rows(optimizer, torch.cat([old, new]), fresh=len(new))
        kept = torch.full((len(mean_gradient),), -1, dtype=torch.long, device=old.device)
        kept[old] = torch.arange(len(old), device=old.device)
        self.mean[len(old) :] += offset * 0.5
        self.log_scale[kept[split]] -= 0.47  # log 1.6
        self.log_scale[len(old) :][torch.isin(new, split)] -= 0.47

    def _keep_rows(self, optimizer: torch.optim.Optimizer, index: Tensor, fresh: int) -> None:
        """Keep the rows `index` of everything; Adam forgets the last `fresh` of them."""
        for group in optimizer.param_groups:
            name = group.get("name")
            if name not in NAMES:
                continue
            old = group["params"][0]
            new = nn.Parameter(old.detach()[index].clone())
            state = optimizer.state.pop(old, None)
            if state:
                for key in ("exp_avg", "exp_avg_sq"):
                    state[key] = state[key][index].clone()
                    state[key][len(index) - fresh :] = 0
                optimizer.state[new] = state
            group["params"] = [new]
            setattr(self, name, new)
        self.anchor = self.anchor[index].clone()
        self.gradient, self.seen = index.new_zeros(len(index)).float(), index.new_zeros(len(index)).float()

    @classmethod
    def empty(cls, count: int) -> CanonicalGaussians:
        """Room for the saved parameters of `count` Gaussians."""
        return cls(torch.zeros(count, 3), torch.zeros(count, 3))
