"""Fitting a 4D scene to pictures: the dense stage, then the sparse one. A run that is stopped or killed continues.

What a step draws depends on (seed, step) alone, so a continued run takes the same steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from dpcli.errors import DpcError
from dpcli.generate4d.config import FitConfig
from dpcli.generate4d.priors.camera_sampling import novel_cameras
from dpcli.generate4d.scene.canonical_gaussians import CanonicalGaussians
from dpcli.generate4d.scene.control_points import ControlPoints
from dpcli.generate4d.scene.identification import ball_neighbors, spatial_loss, temporal_loss
from dpcli.generate4d.scene.initialization import hull, in_sphere, inflated, spread_seeds
from dpcli.generate4d.scene.losses import arap_loss, picture_loss, roundness_loss, thickness_loss
from dpcli.generate4d.scene.model import Instant, Model4D
from dpcli.generate4d.targets import Targets
from dpcli.runtime.progress import Progress
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.seeds import Generate4DStream, torch_seed
from dpcli.runtime.signals import StopRequest

COLUMNS = ("step", "stage", "loss", "psnr", "gaussians", "seconds")
_SAVE_EVERY, _LOG_EVERY, _REFRESH_EVERY = 200, 20, 50
_CARRIERS = 2048  # of the dense stage's Gaussians that the losses on parts and shape look at


class Fit:
    """One fit. `preview(model, step)` is called now and then and once at the end."""

    def __init__(
        self,
        targets: Targets,
        config: FitConfig,
        folder: RunFolder,
        stop: StopRequest,
        seed: int,
        prior: object | None = None,
        device: torch.device | None = None,
        preview: Callable[[Model4D, int], None] | None = None,
        regularize: bool = True,
    ) -> None:
        self.targets, self.config, self.folder, self.stop, self.seed = targets, config, folder, stop, seed
        self.prior, self.preview, self.regularize = prior, preview, regularize
        self.device = device or torch.device("cpu")
        self.step, self.spent = 0, 0.0
        self.control_reference: Tensor | None = None  # [T, K, 3] p-bar of C.13
        self._neighbors: Tensor | None = None
        self._notes: dict = {}
        self.recent: dict[str, list[float]] = {}
        self.times = targets.times().to(self.device)

    # ---- the run -------------------------------------------------------------------------------------------------

    def run(self) -> Model4D:
        """From wherever the folder's state says to the last step."""
        state = self.folder.load_state()
        self._restore(state) if state is not None else self._start()
        started = time.monotonic()
        with Progress("fit", self.config.steps, "step") as bar:
            bar.skip(self.step)
            while self.step < self.config.steps:
                self._one_step()
                bar.note(**self._shown())
                bar.advance()
                if self.step % _SAVE_EVERY == 0 or self.stop.requested or self.step == self.config.steps:
                    self.spent, started = self.spent + time.monotonic() - started, time.monotonic()
                    self._save()
                self.stop.check(f"saved at step {self.step}")
        self.folder.draw_curves()
        return self.model

    def _start(self) -> None:
        rng = np.random.default_rng(np.random.SeedSequence([self.seed, int(Generate4DStream.FIRST_POINTS)]))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(torch_seed(self.seed, Generate4DStream.FIRST_WEIGHTS))
            mean, color = self._first_points(rng)
            sphere = self._start_kind() == "sphere"
            gaussians = CanonicalGaussians(mean, color, opacity=0.05 if sphere else 0.5)
            self.model = Model4D(gaussians, self.config)
            field = self.model.field
            if self.config.seeds:
                field.start_parts(mean, spread_seeds(mean, self.config.parts))
            else:
                field.update_centers(mean)
        self.model.to(self.device)
        self.optimizer = self._new_optimizer()

    def _start_kind(self) -> str:
        if self.config.start != "auto":
            return self.config.start
        return "hull" if self.targets.num_views > 2 else "inflate"

    def _first_points(self, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        config, targets, kind = self.config, self.targets, self._start_kind()
        if kind == "sphere":
            points = in_sphere(config.gaussians, config.start_radius, rng)
            return torch.from_numpy(points), torch.full((len(points), 3), 0.5)
        view, frame = targets.reference, targets.widest_frame()
        if kind == "inflate":
            points, colors = inflated(
                targets.picture(view, frame),
                targets.intrinsics[view],
                targets.world_to_camera[view],
                config.gaussians,
                rng,
            )
        else:
            pictures = [targets.picture(index, frame) for index in range(targets.num_views)]
            points, colors = hull(pictures, targets.intrinsics, targets.world_to_camera, config.gaussians, rng)
        return torch.from_numpy(points), torch.from_numpy(colors)

    # ---- one step ------------------------------------------------------------------------------------------------

    def _one_step(self) -> None:
        config, rng = self.config, self._draws()
        if self.step == config.sparse_from:
            self._begin_sparse()
        if self.step % _REFRESH_EVERY == 0:
            self.model.refresh_neighbors()
            self._neighbors = None
        views, frames = self._pick(rng)
        self._set_rates()
        instant = self.model.at(self.times[frames])
        loss, squared = self._picture_terms(instant, views, frames, rng)
        if self.prior is not None:
            loss = loss + config.augmentation * self._prior_term(instant, frames, rng)
        loss = loss + self._motion_terms(instant, frames)
        if not math.isfinite(float(loss.detach())):
            raise DpcError(
                f"{self.folder.path}: the loss became {float(loss.detach())} at step {self.step}; the last checkpoint is kept;"
                " try smaller rates or another --seed"
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._watch(self._notes)
        self.optimizer.step()
        self._limit()
        self.step += 1
        self._record(float(loss.detach()), squared)
        if self.step % config.grow_every == 0 and self.step < config.steps - config.grow_every:
            self._densify(rng)

    def _draws(self) -> torch.Generator:
        return torch.Generator().manual_seed(torch_seed(self.seed, Generate4DStream.STEP, self.step))

    def _pick(self, rng: torch.Generator) -> tuple[list[int], list[int]]:
        """(view, frame) of the step's pictures: every second one the reference, the others from the given views.
        Times are spread: picture i of the batch comes from the i-th part of the clip, in random rotation."""
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

    def _shrink(self) -> int:
        share = self.step / self.config.steps
        for until, factor in self.config.coarse:
            if share < until:
                return factor
        return 1

    def _picture_terms(
        self, instant: Instant, views: list[int], frames: list[int], rng: torch.Generator
    ) -> tuple[Tensor, float]:
        config = self.config
        wanted, intrinsics, poses = (t.to(self.device) for t in self.targets.at(views, frames, self._shrink()))
        height, width = wanted.shape[1:3]
        black = torch.rand(len(views), 1, generator=rng) < config.inversion
        background = torch.where(black, torch.zeros(1, 3), torch.ones(1, 3)).to(self.device)
        rendered, alpha, notes = self.model.render(instant, poses, intrinsics, width, height, background)
        if notes["means2d"].requires_grad:
            notes["means2d"].retain_grad()
        self._notes = notes
        weights = [1.0 if view == self.targets.reference else config.views for view in views]
        terms = [
            weight * picture_loss(rendered[[i]], alpha[[i]], wanted[[i]], background[[i]], config.foreground)
            for i, weight in enumerate(weights)
        ]
        white = wanted[..., :3] + 1 - wanted[..., 3:]
        shown = rendered + (1 - alpha) * (1 - background[:, None, None])
        with torch.no_grad():
            errors = [
                float((shown[i] - white[i]).square().mean()) for i, v in enumerate(views) if v == self.targets.reference
            ]
        return config.reconstruction * torch.stack(terms).mean(), float(np.mean(errors)) if errors else math.nan

    def _prior_term(self, instant: Instant, frames: list[int], rng: torch.Generator) -> Tensor:
        """What a generative prior says of random new views of the step's frames (C.11)."""
        size = min(max(self.targets.size), 256)
        cameras, poses, intrinsics = novel_cameras(self.targets, len(frames), size, rng)
        white = torch.ones(len(frames), 3, device=self.device)
        rendered, _, _ = self.model.render(
            instant, poses.to(self.device), intrinsics.to(self.device), size, size, white
        )
        return self.prior.loss(rendered, cameras, frames, self.step / self.config.steps, rng)

    def _motion_terms(self, instant: Instant, frames: list[int]) -> Tensor:
        """Losses on what carries the Gaussians: parts, shape over time, and the drift of control points."""
        config, motion, carriers = self.config, instant.motion, instant.carriers
        total = torch.zeros((), device=self.device)
        picked = self._picked(len(carriers))
        points, moved, part = carriers[picked], motion.displacement[:, picked], motion.part[:, picked]
        if self._neighbors is None or len(self._neighbors) != len(points):
            self._neighbors = ball_neighbors(points, config.spatial_radius, config.spatial_neighbors)
        if config.rigid and config.temporal:
            term = temporal_loss(points, moved, part)
            total = total + config.identification * config.temporal_weight * term
        if config.rigid and config.spatial:
            total = total + config.identification * config.spatial_weight * spatial_loss(part, self._neighbors)
        if self.control_reference is not None:
            drift = carriers + motion.displacement - self.control_reference[frames]
            total = total + config.control * drift.square().sum(-1).mean()
        if config.arap:
            total = total + config.arap * arap_loss(points, points + moved, self._neighbors)
        if self.regularize and self.targets.num_views == 1:
            axis = torch.from_numpy(self.targets.world_to_camera[self.targets.reference][2, :3]).float().to(self.device)
            total = total + config.thickness * thickness_loss(self.model.gaussians, axis)
        if self.regularize:
            total = total + config.roundness * roundness_loss(self.model.gaussians, config.aspect)
        return total

    def _picked(self, count: int) -> Tensor:
        """Which carriers the losses look at: all control points, a fixed thin selection of dense Gaussians."""
        if count <= _CARRIERS:
            return torch.arange(count)
        return torch.linspace(0, count - 1, _CARRIERS).long()

    # ---- keeping house -------------------------------------------------------------------------------------------

    def _begin_sparse(self) -> None:
        """Put control points among the Gaussians and remember where the dense stage would move them (p-bar)."""
        self.model.start_control()
        self.optimizer.add_param_group(
            {"params": [self.model.control.position], "lr": self.config.rate_control, "name": "control"}
        )
        self.optimizer.add_param_group(
            {"params": [self.model.control.log_radius], "lr": self.config.rate_radius, "name": "radius"}
        )
        with torch.no_grad():
            position = self.model.control.position
            self.control_reference = torch.cat(
                [position + self.model.field(position, self.times[[f]]).displacement for f in range(len(self.times))]
            )

    def _new_optimizer(self) -> torch.optim.Adam:
        config, field = self.config, self.model.field
        rigid = [p for name, p in field.named_parameters() if name.startswith("movement")]
        rest = [p for name, p in field.named_parameters() if not name.startswith("movement")]
        groups = self.model.gaussians.groups(config)
        groups.append({"params": rest, "lr": config.rate_network[0], "name": "network"})
        groups.append({"params": rigid, "lr": config.rate_rigid, "name": "rigid"})
        return torch.optim.Adam(groups, eps=1e-15)

    def _set_rates(self) -> None:
        share = self.step / max(self.config.steps - 1, 1)
        for group in self.optimizer.param_groups:
            for name, (first, last) in (("mean", self.config.rate_mean), ("network", self.config.rate_network)):
                if group["name"] == name:
                    group["lr"] = first * (last / first) ** share

    def _watch(self, notes: dict) -> None:
        gradient = notes["means2d"].grad
        if gradient is not None:
            self.model.gaussians.watch(gradient, notes["radii"], notes["width"], notes["height"])

    @torch.no_grad()
    def _limit(self) -> None:
        """Keep sizes within what a picture can tell and colors within what it can show."""
        self.model.gaussians.log_scale.clamp_(math.log(1e-4), math.log(0.4))
        self.model.gaussians.color.clamp_(0.0, 1.0)

    def _densify(self, rng: torch.Generator) -> None:
        grow = self.step < self.config.grow_until * self.config.steps
        self.model.gaussians.grow_and_prune(self.optimizer, self.config, rng, grow)
        self.model.refresh_neighbors()
        self._neighbors = None

    def _record(self, loss: float, squared: float) -> None:
        self.recent.setdefault("loss", []).append(loss)
        if math.isfinite(squared):
            self.recent.setdefault("squared", []).append(squared)
        if self.step % _LOG_EVERY == 0 or self.step == self.config.steps:
            shown = self._shown()
            stage = "sparse" if self.model.control is not None else "dense"
            self.folder.log({"step": self.step, "stage": stage, "seconds": round(self.spent, 1), **shown})
            self.recent = {key: values[-8:] for key, values in self.recent.items()}
        if self.preview is not None and (self.step % max(self.config.steps // 5, 1) == 0):
            self.preview(self.model, self.step)

    def _shown(self) -> dict:
        mean = {key: float(np.mean(values)) for key, values in self.recent.items()}
        psnr = -10 * math.log10(max(mean.get("squared", 1.0), 1e-10))
        return {
            "loss": round(mean.get("loss", math.nan), 3),
            "psnr": round(psnr, 2),
            "gaussians": len(self.model.gaussians),
        }

    # ---- checkpoints ---------------------------------------------------------------------------------------------

    def _save(self) -> None:
        gaussians = self.model.gaussians
        state = {
            "step": self.step,
            "spent": self.spent,
            "gaussians": gaussians.state_dict(),
            "field": self.model.field.state_dict(),
            "control": None if self.model.control is None else self.model.control.state_dict(),
            "control_reference": self.control_reference,
            "optimizer": self.optimizer.state_dict(),
            "recent": self.recent,
            "nearest": self.model.nearest,
            "neighbors": self._neighbors,
        }
        self.folder.save_state(state)

    def _restore(self, state: dict) -> None:
        self.step, self.spent, self.recent = state["step"], state["spent"], state["recent"]
        gaussians = CanonicalGaussians.empty(len(state["gaussians"]["mean"]))
        gaussians.load_state_dict(state["gaussians"])
        self.model = Model4D(gaussians, self.config)
        self.model.field.load_state_dict(state["field"])
        self.model.to(self.device)
        self.optimizer = self._new_optimizer()
        if state["control"] is not None:
            self.model.control = ControlPoints(state["control"]["position"], self.config.neighbors).to(self.device)
            self.model.control.load_state_dict(state["control"])
            for name, key in (("control", "position"), ("radius", "log_radius")):
                self.optimizer.add_param_group({"params": [getattr(self.model.control, key)], "lr": 0.0, "name": name})
            self.control_reference = state["control_reference"].to(self.device)
        self.optimizer.load_state_dict(state["optimizer"])
        self.model.nearest, self._neighbors = (
            None if state[key] is None else state[key].to(self.device) for key in ("nearest", "neighbors")
        )
