"""The canonical 3D Gaussians: their learned parameters, and how densification and pruning change their number."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.generate4d.config import FitConfig
from dpcli.generate4d.scene.control_points import mean_neighbor_distance
from dpcli.ops.rotations import normalize_quaternion, rotate_by_quaternion

_SPLIT = 0.47  # log 1.6: how much smaller the halves of a split Gaussian are (Kerbl et al. 2023)
NAMES = ("mean", "log_scale", "quaternion", "opacity_logit", "color")


class CanonicalGaussians(nn.Module):
    """Holds the parameters of N Gaussians: mean, log_scale (N,3), quaternion (N,4), opacity_logit (N), color (N,3) 0..1.

    `anchor` (N,3) remembers where each one (or its ancestor) was put at the start; it isn't learned.
    """

    def __init__(self, mean: Tensor, color: Tensor, opacity: float = 0.5) -> None:
        super().__init__()
        scale = mean_neighbor_distance(mean).clamp(1e-4, 0.05)
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
        """Returns N."""
        return len(self.mean)

    def parameter_groups(self, config: FitConfig) -> list[dict]:
        """Returns the parameter groups for Adam, named, with their first rates."""
        rates = (config.rate_mean[0], config.rate_scale, config.rate_quaternion, config.rate_opacity, config.rate_color)
        return [{"params": [getattr(self, name)], "lr": rate, "name": name} for name, rate in zip(NAMES, rates)]

    @torch.no_grad()
    def add_screen_gradient(self, gradient: Tensor, radii: Tensor, width: int, height: int) -> None:
        """Adds up the screen gradients (C,N,2) of Gaussians that are in a picture, in units of half its width and height."""
        seen = (radii > 0).reshape(*gradient.shape[:2], -1).any(-1)
        size = (gradient * gradient.new_tensor([width / 2, height / 2])).norm(dim=-1)
        self.gradient += (size * seen).sum(0)
        self.seen += seen.sum(0)

    @torch.no_grad()
    def densify_and_prune(
        self, optimizer: torch.optim.Optimizer, config: FitConfig, rng: torch.Generator, grow: bool
    ) -> None:
        """Copies or splits the Gaussians with the largest mean screen gradient, then drops the transparent ones.

        Small ones are cloned, large ones (above the median size) split in two of 1/1.6 the size, as in 3D Gaussian
        splatting (Kerbl et al. 2023); Adam's memory of a copy starts at zero. grow: False only prunes.
        """
        before, keep = len(self), self.opacity_logit.sigmoid() >= config.prune_opacity
        chosen = self._choose_to_grow(keep, config) if grow else torch.zeros_like(keep)
        if not keep.any():
            keep[self.opacity_logit.argmax()] = True
        old, new = keep.nonzero()[:, 0], chosen.nonzero()[:, 0]
        size = self.log_scale.max(1).values
        split = new[size[new] > size.median()]
        offset = torch.randn(len(new), 3, generator=rng).to(self.mean.device) * self.log_scale[new].exp()
        offset = rotate_by_quaternion(normalize_quaternion(self.quaternion[new]), offset)
        self._keep_rows(optimizer, torch.cat([old, new]), fresh=len(new))
        row_now = torch.full((before,), -1, dtype=torch.long, device=old.device)
        row_now[old] = torch.arange(len(old), device=old.device)
        self.mean[len(old) :] += offset * 0.5
        self.log_scale[row_now[split]] -= _SPLIT
        self.log_scale[len(old) :][torch.isin(new, split)] -= _SPLIT

    def _choose_to_grow(self, keep: Tensor, config: FitConfig) -> Tensor:  # [N] -> [N]
        """Returns which of the Gaussians to keep are copied: those of the largest mean screen gradient, as room allows."""
        chosen = torch.zeros_like(keep)
        room = min(int(config.grow_share * len(self)), config.max_gaussians - int(keep.sum()))
        if room > 0:
            gradient = self.gradient / self.seen.clamp(min=1)
            best = torch.where(keep, gradient, torch.zeros_like(gradient)).topk(min(room, len(self)), sorted=True)
            chosen[best.indices[best.values > config.grow_threshold]] = True
        return chosen

    def _keep_rows(self, optimizer: torch.optim.Optimizer, index: Tensor, fresh: int) -> None:
        """Keeps the rows `index` of all parameters; Adam forgets the last `fresh` of them."""
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
        """Returns `count` Gaussians of no meaning, whose parameters are loaded next."""
        return cls(torch.zeros(count, 3), torch.zeros(count, 3))
