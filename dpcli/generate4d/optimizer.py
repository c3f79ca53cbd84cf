"""The dense-to-sparse optimization of a 4D scene: what one step draws, which losses it adds, and how the Gaussians grow in number.

What a step draws depends on (seed, step) alone, so an optimization that was saved and restored takes the same steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.generate4d.config import FitConfig
from dpcli.generate4d.priors.camera_sampling import novel_cameras
from dpcli.generate4d.priors.interface import Prior, RelativeCamera
from dpcli.generate4d.scene.canonical_gaussians import CanonicalGaussians
from dpcli.generate4d.scene.control_points import ControlPoints
from dpcli.generate4d.scene.identification import ball_neighbors, spatial_loss, temporal_loss
from dpcli.generate4d.scene.initialization import choose_start, first_points, spread_seeds
from dpcli.generate4d.scene.losses import arap_loss, picture_loss, thickness_loss
from dpcli.generate4d.scene.model import Instant, Model4D
from dpcli.generate4d.shape.guidance import ShapeGuidance
from dpcli.generate4d.targets import Targets
from dpcli.runtime.seeds import Generate4DStream, torch_seed

_REFRESH_EVERY = 50  # steps between two searches for neighbors
_CARRIERS = 2048  # of the dense stage's Gaussians that the losses on parts and shape look at
_PRIOR_SIZE = 256  # pixels at most of the pictures that a prior judges
_SHAPE_FOREGROUND = 1.0  # weight of silhouettes beside colors, which a prior knows less well
_FIRST_OPACITY = {"sphere": 0.05, "hull": 0.5, "inflate": 0.8}  # a surface hides what is behind it, a volume is all fog
_SMALLEST, _LARGEST = 1e-4, 0.4  # of a Gaussian, scene units: what a picture can tell


@dataclass(frozen=True)
class StepResult:
    """Holds the loss of a step, the reference view's squared error (nan without that view), and how many Gaussians there were."""

    loss: float
    squared_error: float
    gaussians: int


class SceneOptimizer:
    """Fits a `Model4D` to pictures with Adam, first its dense stage (eq. 5.7), then the sparse one (eq. 5.9).

    prior: judges random novel views (eq. C.11); shape: shows every frame from novel views; None: none does. regularize: keeps
    one view's object from going flat (`thickness`, `aspect`).
    `start` or `restore` must be called before the first step.
    """

    def __init__(
        self,
        targets: Targets,
        config: FitConfig,
        seed: int,
        prior: Prior | None = None,
        device: torch.device | None = None,
        regularize: bool = True,
        shape: ShapeGuidance | None = None,
    ) -> None:
        self.targets, self.config, self.seed = targets, config, seed
        self.prior, self.regularize, self.shape = prior, regularize, shape
        self.device = device or torch.device("cpu")
        self.step = 0
        self.control_reference: Tensor | None = None  # [T, K, 3] p-bar of eq. C.13
        self._neighbors: Tensor | None = None
        self.times = targets.times().to(self.device)

    def start(self) -> None:
        """Puts the first Gaussians and parts where the settings say."""
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, int(Generate4DStream.FIRST_POINTS)]))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(torch_seed(self.seed, Generate4DStream.FIRST_WEIGHTS))
            kind = choose_start(self.config, self.targets)
            mean, color = first_points(kind, self.config, self.targets, rng, self.shape)
            gaussians = CanonicalGaussians(mean, color, opacity=_FIRST_OPACITY[kind])
            self.model = Model4D(gaussians, self.config)
            field = self.model.field
            if self.config.seeds:
                field.start_parts(mean, spread_seeds(mean, self.config.blended_parts))
            else:
                field.update_centers(mean)
        self.model.to(self.device)
        self.optimizer = self._new_optimizer()

    def take_step(self) -> StepResult:
        """Takes the next step. Raises FloatingPointError, with the model as it was, when it or the loss is not finite."""
        config, rng = self.config, self._step_generator()
        if self.step == config.sparse_from:
            self._begin_sparse()
        if self.step % _REFRESH_EVERY == 0:
            self.model.refresh_neighbors()
            self._neighbors = None
        views, frames = self._draw_pictures(rng)
        self._set_learning_rates()
        instant = self.model.at(self.times[frames])
        self.model.require_finite(instant)
        loss, squared, notes = self._picture_terms(instant, views, frames, rng)
        if self.prior is not None:
            loss = loss + config.augmentation * self._prior_term(instant, frames, rng)
        if self.shape is not None and self.step < config.shape_until * config.steps:
            loss = loss + self._shape_term(instant, frames, rng)
        loss = loss + self._motion_terms(instant, frames)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FloatingPointError(f"the loss became {value}")
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._add_screen_gradient(notes)
        self.optimizer.step()
        self._clamp_gaussians()
        self.step += 1
        result = StepResult(value, squared, len(self.model.gaussians))
        if self.step % config.grow_every == 0 and self.step < config.steps - config.grow_every:
            self._densify(rng)
        return result

    @torch.no_grad()
    def require_finite(self) -> None:
        """Raises FloatingPointError where the model can't be drawn in some frame."""
        for number in range(len(self.times)):  # one at a time: all frames of a large model fill the memory
            self.model.require_finite(self.model.at(self.times[number : number + 1]))

    def _step_generator(self) -> torch.Generator:
        return torch.Generator().manual_seed(torch_seed(self.seed, Generate4DStream.STEP, self.step))

    def _draw_pictures(self, rng: torch.Generator) -> tuple[list[int], list[int]]:
        """Returns views and frames of the step's pictures: the reference in turn with random ones of the given views.

        Times are spread: picture i of the batch comes from the i-th part of the clip, in random rotation.
        """
        targets, batch = self.targets, self.config.batch
        others = [view for view in range(targets.num_views) if view != targets.reference]
        start = torch.rand(1, generator=rng).item()
        frames = [int((start + index / batch) % 1.0 * targets.num_frames) for index in range(batch)]
        views = []
        for index in range(batch):
            drawn = int(torch.randint(max(len(others), 1), (1,), generator=rng))
            alternate = (self.step * batch + index) % max(2, min(4, targets.num_views))
            views.append(others[drawn] if others and alternate else targets.reference)
        return views, frames

    def _shrink_factor(self) -> int:
        share = self.step / self.config.steps
        return next((factor for until, factor in self.config.coarse if share < until), 1)

    def _picture_terms(
        self, instant: Instant, views: list[int], frames: list[int], rng: torch.Generator
    ) -> tuple[Tensor, float, dict]:
        """Returns the loss on the step's pictures, the reference view's squared error on white, the rasterizer's notes."""
        config = self.config
        truth, intrinsics, poses = (t.to(self.device) for t in self.targets.at(views, frames, self._shrink_factor()))
        height, width = truth.shape[1:3]
        background = self._backgrounds(len(views), rng)
        rendered, alpha, notes = self.model.render(instant, poses, intrinsics, width, height, background)
        if notes["means2d"].requires_grad:
            notes["means2d"].retain_grad()
        weights = [1.0 if view == self.targets.reference else config.views for view in views]
        terms = [
            weight * picture_loss(rendered[[i]], alpha[[i]], truth[[i]], background[[i]], config.foreground)
            for i, weight in enumerate(weights)
        ]
        with torch.no_grad():
            on_white = rendered + (1 - alpha) * (1 - background[:, None, None])
            errors = (on_white - (truth[..., :3] + 1 - truth[..., 3:])).square()
            squared = [float(errors[i].mean()) for i, view in enumerate(views) if view == self.targets.reference]
        loss = config.reconstruction * torch.stack(terms).mean()
        return loss, float(np.mean(squared)) if squared else math.nan, notes

    def _prior_term(self, instant: Instant, frames: list[int], rng: torch.Generator) -> Tensor:
        """Returns the prior's loss on random novel views of the step's frames (C.11)."""
        size = min(max(self.targets.size), _PRIOR_SIZE)
        cameras, poses, intrinsics = self._novel_cameras(len(frames), size, rng)
        white = torch.ones(len(frames), 3, device=self.device)
        rendered, _, _ = self.model.render(instant, poses, intrinsics, size, size, white)
        return self.prior.loss(rendered, cameras, frames, self.step / self.config.steps, rng)

    def _shape_term(self, instant: Instant, frames: list[int], rng: torch.Generator) -> Tensor:
        """Returns the loss on the shape prior's pictures of the step's frames from random novel views."""
        config, size = self.config, min(self.config.shape_size, *self.targets.size)
        _, poses, intrinsics = self._novel_cameras(len(frames), size, rng)
        background = self._backgrounds(len(frames), rng)
        truth = self.shape.pictures(frames, poses, intrinsics, size)
        rendered, alpha, _ = self.model.render(instant, poses, intrinsics, size, size, background)
        weight = config.reconstruction * self._log_linear(config.shape)
        return weight * picture_loss(rendered, alpha, truth, background, _SHAPE_FOREGROUND)

    def _novel_cameras(
        self, count: int, size: int, rng: torch.Generator
    ) -> tuple[list[RelativeCamera], Tensor, Tensor]:
        """Returns what `novel_cameras` does, on the fit's device."""
        cameras, poses, intrinsics = novel_cameras(self.targets, count, size, rng)
        return cameras, poses.to(self.device), intrinsics.to(self.device)

    def _log_linear(self, ends: tuple[float, float]) -> float:
        """Returns where a value stands at this step that goes log-linearly from its first to its last."""
        first, last = ends
        return first * (last / first) ** (self.step / max(self.config.steps - 1, 1))

    def _backgrounds(self, count: int, rng: torch.Generator) -> Tensor:  # [count, 3]
        """Returns backgrounds, each black or white, so that neither color can pass for transparency."""
        black = torch.rand(count, 1, generator=rng) < self.config.inversion
        return torch.where(black, torch.zeros(1, 3), torch.ones(1, 3)).to(self.device)

    def _motion_terms(self, instant: Instant, frames: list[int]) -> Tensor:
        """Returns the losses on what carries the Gaussians: parts, control points (C.13), shape over time."""
        config, motion, carriers = self.config, instant.motion, instant.carriers
        total = torch.zeros((), device=self.device)
        chosen = _thin(len(carriers))
        points, moved, part = carriers[chosen], motion.displacement[:, chosen], motion.part[:, chosen]
        if self._neighbors is None or len(self._neighbors) != len(points):
            self._neighbors = ball_neighbors(points, config.spatial_radius, config.spatial_neighbors)
        if config.rigid and config.temporal:
            total = total + config.identification * config.temporal_weight * temporal_loss(points, moved, part)
        if config.rigid and config.spatial:
            total = total + config.identification * config.spatial_weight * spatial_loss(part, self._neighbors)
        if self.control_reference is not None:
            drift = carriers + motion.displacement - self.control_reference[frames]
            total = total + config.control * drift.square().sum(-1).mean()
        if config.arap:
            total = total + config.arap * arap_loss(points, points + moved, self._neighbors)
        if self.regularize and self.targets.num_views == 1:
            axis = torch.from_numpy(self.targets.world_to_camera[self.targets.reference][2, :3]).float().to(self.device)
            own = self.model.gaussians
            # a shape prior says where they are, but differs from frame to frame by more than what moves
            rest = own.anchor if self.shape is None else own.mean
            total = total + config.thickness * thickness_loss(instant.mean, rest, axis)
        return total

    def _begin_sparse(self) -> None:
        """Puts control points among the Gaussians and remembers where the dense stage would move them (p-bar)."""
        self.model.start_control()
        self._add_control_groups()
        with torch.no_grad():
            position = self.model.control.position
            self.control_reference = torch.cat(
                [position + self.model.field(position, self.times[[f]]).displacement for f in range(len(self.times))]
            )

    def _new_optimizer(self) -> torch.optim.Adam:
        config, field = self.config, self.model.field
        rigid = [p for name, p in field.named_parameters() if name.startswith("movement")]
        rest = [p for name, p in field.named_parameters() if not name.startswith("movement")]
        groups = self.model.gaussians.parameter_groups(config)
        groups.append({"params": rest, "lr": config.rate_network[0], "name": "network"})
        groups.append({"params": rigid, "lr": config.rate_rigid, "name": "rigid"})
        return torch.optim.Adam(groups, eps=1e-15)

    def _add_control_groups(self) -> None:
        control, config = self.model.control, self.config
        for name, parameter, rate in (
            ("control", control.position, config.rate_control),
            ("radius", control.log_radius, config.rate_radius),
        ):
            self.optimizer.add_param_group({"params": [parameter], "lr": rate, "name": name})

    def _set_learning_rates(self) -> None:
        """Sets the rates that fall log-linearly from their first value to their last."""
        falling = {"mean": self.config.rate_mean, "network": self.config.rate_network}
        for group in self.optimizer.param_groups:
            if group["name"] in falling:
                group["lr"] = self._log_linear(falling[group["name"]])

    def _add_screen_gradient(self, notes: dict) -> None:
        gradient = notes["means2d"].grad
        if gradient is not None:
            self.model.gaussians.add_screen_gradient(gradient, notes["radii"], notes["width"], notes["height"])

    @torch.no_grad()
    def _clamp_gaussians(self) -> None:
        """Keeps sizes within what a picture can tell and colors within what it can show."""
        sizes = self.model.gaussians.log_scale.clamp_(math.log(_SMALLEST), math.log(_LARGEST))
        if self.regularize:  # a needle along the line of sight is unseen in the one picture, a splinter in all others
            torch.minimum(sizes, sizes.mean(1, keepdim=True) + math.log(self.config.aspect), out=sizes)
        self.model.gaussians.color.clamp_(0.0, 1.0)

    def _densify(self, rng: torch.Generator) -> None:
        grow = self.step < self.config.grow_until * self.config.steps
        self.model.gaussians.densify_and_prune(self.optimizer, self.config, rng, grow)
        self.model.refresh_neighbors()
        self._neighbors = None

    def state(self) -> dict:
        """Returns all that `restore` needs to go on with the same steps."""
        control = self.model.control
        return {
            "step": self.step,
            "gaussians": self.model.gaussians.state_dict(),
            "field": self.model.field.state_dict(),
            "control": None if control is None else control.state_dict(),
            "control_reference": self.control_reference,
            "optimizer": self.optimizer.state_dict(),
            "nearest": self.model.nearest,
            "neighbors": self._neighbors,
        }

    def restore(self, state: dict) -> None:
        """Goes on where the `state` of an earlier optimization with the same settings was saved."""
        self.step = state["step"]
        gaussians = CanonicalGaussians.empty(len(state["gaussians"]["mean"]))
        gaussians.load_state_dict(state["gaussians"])
        self.model = Model4D(gaussians, self.config)
        self.model.field.load_state_dict(state["field"])
        self.model.to(self.device)
        self.optimizer = self._new_optimizer()
        if state["control"] is not None:
            self.model.control = ControlPoints(state["control"]["position"], self.config.neighbors).to(self.device)
            self.model.control.load_state_dict(state["control"])
            self._add_control_groups()
            self.control_reference = state["control_reference"].to(self.device)
        self.optimizer.load_state_dict(state["optimizer"])
        self.model.nearest, self._neighbors = (
            None if state[key] is None else state[key].to(self.device) for key in ("nearest", "neighbors")
        )


def _thin(count: int) -> Tensor:
    """Returns which carriers the losses look at: all control points, a fixed thin selection of dense Gaussians."""
    if count <= _CARRIERS:
        return torch.arange(count)
    return torch.linspace(0, count - 1, _CARRIERS).long()
