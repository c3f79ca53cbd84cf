"""The loss of one batch of pairs in online training: which of the thesis's terms are on, how much each counts (section 4.4.4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dpcli.ops import weighted_kabsch
from dpcli.ops.rotations import normalize_quaternion, quaternion_to_matrix
from dpcli.segment.flow.object_aware_icp import object_aware_icp
from dpcli.segment.flow.rigid_groups import rigid_groups
from dpcli.segment.network.motion_head import rotation_loss
from dpcli.segment.network.part_network import FrameParts, PartNetwork
from dpcli.segment.network.slot_matching import match_slots, permute_slots
from dpcli.segment.smoothness import smoothness_loss, smoothness_neighbors
from dpcli.segment.training.losses import consensus_weights, dynamic_loss, invariance_loss, rigid_loss, supervised_loss
from dpcli.segment.training.settings import Objective


@dataclass
class Batch:
    """Holds B pairs.

    points (2B,N,3): frames 1, then frames 2; flow (2B,N,3): of each to the other; part (2B,N): -1 unknown.
    """

    points: Tensor
    flow: Tensor
    part: Tensor


def swap(values: Tensor) -> Tensor:
    """Returns the values of frames 2 first, then those of frames 1."""
    return values.roll(len(values) // 2, 0)


@dataclass
class Outcome:
    """Holds the loss to minimize, its terms for the log, and the corrected flow if it was asked for."""

    loss: Tensor
    terms: dict[str, float]
    flow: Tensor | None = None


def pair_loss(model: PartNetwork, batch: Batch, objective: Objective, progress: float, rng: torch.Generator) -> Outcome:
    """Returns the loss of a batch with every term that is on at `progress`, the share (0 to 1) of the training that is over.

    rng: of the turns that the invariance is judged by.
    """
    frames = model(batch.points)
    if objective.supervised:
        return _supervised(model, batch, frames, objective)
    mask = frames.mask
    rotation, translation = weighted_kabsch(batch.points, batch.points + batch.flow, mask.detach())
    needs_match = model.motion is not None and progress >= min(objective.motion_after, objective.update_after)
    order = _match(batch, mask) if needs_match else None
    beta = None
    terms: dict[str, Tensor] = {}
    if order is not None and progress >= objective.motion_after:
        matched = _matched(mask.detach(), order)
        answer = model.pair(batch.points, frames, matched)
        terms["motion"] = objective.motion * _motion(model, answer, matched, rotation)
        if objective.consensus != "none" and progress >= objective.consensus_after:
            motions = model.motions(batch.points, frames, matched, answer)
            beta = _consensus(batch, mask.detach(), order, motions, objective)
    if objective.cold_start and progress < objective.cold_until:
        terms["cold_start"] = objective.cold_start * _cold_start(batch, mask)
    terms["dynamic"] = objective.dynamic * _rigidity(batch, mask, rotation, translation, beta, objective)
    if progress >= objective.smooth_after:
        terms["smooth"] = objective.smooth * smoothness_loss(mask, smoothness_neighbors(batch.points))
    if objective.invariance:
        turned, _ = turn_randomly(batch.points, rng)
        terms["invariance"] = objective.invariance * invariance_loss(mask, model(turned).mask)
    loss = torch.stack(list(terms.values())).sum()
    values = {name: float(term.detach()) for name, term in terms.items()}
    if beta is not None:
        values["consensus"] = float((beta * mask.detach()).sum(-1).mean())
    update = objective.flow_decay < 1 and progress >= objective.update_after
    return Outcome(loss, values, _corrected(batch, mask.detach(), order, objective) if update else None)


def _cold_start(batch: Batch, mask: Tensor) -> Tensor:
    """Returns the cross-entropy with the bodies that each frame's flow shows.

    Frames that show one body teach nothing and are left out.
    """
    bodies = rigid_groups(batch.points, batch.flow, most=mask.shape[-1])
    telling = bodies.amax(1) > 0
    return supervised_loss(mask[telling], bodies[telling]) if telling.any() else mask.sum() * 0


def _rigidity(
    batch: Batch, mask: Tensor, rotation: Tensor, translation: Tensor, beta: Tensor | None, objective: Objective
) -> Tensor:
    """Returns the rigidity loss in the form that the objective names, weighted by the consensus where there is one."""
    if objective.form == "per-part":  # the mean over slots of eq. 4.8, times their number: of the blended form's size
        return mask.shape[-1] * rigid_loss(batch.points, batch.flow, mask, rotation, translation, beta)
    trust = None if beta is None else (beta * mask.detach()).sum(-1)  # the blended form has one residual per point
    return dynamic_loss(batch.points, batch.flow, mask, rotation, translation, trust)


def _match(batch: Batch, mask: Tensor) -> Tensor:
    """Returns the order (B,S) of frames 2's slots that agrees with frames 1's."""
    first = len(batch.points) // 2
    return match_slots(batch.points[:first], batch.flow[:first], mask[:first], batch.points[first:], mask[first:])


def _matched(mask: Tensor, order: Tensor) -> Tensor:
    """Returns masks with frames 2's slots in the order of frames 1's."""
    first = len(mask) // 2
    return torch.cat([mask[:first], permute_slots(mask[first:], order)])


def _motion(model: PartNetwork, answer: tuple[Tensor, Tensor], matched: Tensor, rotation: Tensor) -> Tensor:
    """Returns the loss of the motion head's answer (`PartNetwork.pair`) against the rotations that flow and masks imply.

    Only slots of more than 2 % of the points count.
    """
    half = len(matched) // 2
    share = matched.mean(1)
    weight = torch.minimum(share[:half], share[half:])
    weight = torch.where(weight > 0.02, weight, 0.0)
    return rotation_loss(*answer, rotation[:half], weight, model.motion.group)


@torch.no_grad()
def _consensus(
    batch: Batch, mask: Tensor, order: Tensor, motions: tuple[Tensor, Tensor], objective: Objective
) -> Tensor:
    """Returns beta (2B,N,S) of eq. 4.7.

    motions: the head's, from frames 1 to 2; frames 2 to 1 have their inverse, in frames 2's slots.
    """
    rotation, translation = motions
    back, inverse = order.argsort(1), rotation.mT
    inverse_shift = -(inverse @ translation[..., None]).squeeze(-1)
    both = torch.cat([rotation, _permute(inverse, back)]), torch.cat([translation, _permute(inverse_shift, back)])
    return consensus_weights(batch.points, batch.flow, *both, tau=objective.tau, form=objective.consensus, mask=mask)


def _permute(values: Tensor, order: Tensor) -> Tensor:
    """Returns values (B,S,...) in the order (B,S)."""
    return values.gather(1, order.view(*order.shape, *[1] * (values.ndim - 2)).expand_as(values))


@torch.no_grad()
def _corrected(batch: Batch, mask: Tensor, order: Tensor | None, objective: Objective) -> Tensor:
    """Returns the flow of eq. 4.6: alpha of the flow before, 1 - alpha of what object-aware ICP makes of it."""
    order = _match(batch, mask) if order is None else order
    both = torch.cat([order, order.argsort(1)])
    newest, _, _ = object_aware_icp(batch.points, swap(batch.points), mask, swap(mask), batch.flow, order=both)
    return objective.flow_decay * batch.flow + (1 - objective.flow_decay) * newest


def _supervised(model: PartNetwork, batch: Batch, frames: FrameParts, objective: Objective) -> Outcome:
    """Returns the loss with labels for the masks and the true flow for the motion head."""
    terms = {"mask": supervised_loss(frames.mask, batch.part)}
    if model.motion is not None:
        slots = model.config.slots
        truth = torch.nn.functional.one_hot(batch.part.clamp(0, slots - 1), slots).float()
        truth = truth * ((batch.part >= 0) & (batch.part < slots))[..., None]  # others move with none of these parts
        rotation, _ = weighted_kabsch(batch.points, batch.points + batch.flow, truth)
        terms["motion"] = objective.motion * _motion(model, model.pair(batch.points, frames, truth), truth, rotation)
    loss = torch.stack(list(terms.values())).sum()
    return Outcome(loss, {name: float(term.detach()) for name, term in terms.items()})


def turn_randomly(points: Tensor, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """Returns each pair (frames b and b + B) turned by a rotation of its own: points (2B,N,3), rotations (2B,3,3)."""
    half = len(points) // 2
    rotation = quaternion_to_matrix(normalize_quaternion(torch.randn(half, 4, generator=rng))).to(points)
    rotation = torch.cat([rotation, rotation])
    return points @ rotation.mT, rotation
