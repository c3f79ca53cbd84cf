"""Parts and motions of one sequence: a segmenter says masks of thinned frames, everything after is the same for all of them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.ops import fps, knn, three_nn_interpolate, weighted_kabsch
from dpcli.ops.rigid import rigid_flow, to_matrix
from dpcli.runtime.seeds import generator
from dpcli.runtime.tuning import torch_threads
from dpcli.segment.flow.object_icp import object_icp
from dpcli.segment.frame_pairs import choose_points, sequence_scale
from dpcli.segment.network.part_network import PartNetwork
from dpcli.segment.network.slot_matching import carry_mask, match_sequence, one_hot
from dpcli.segment.split_parts import split_by_motion
from dpcli.store import CloudSequence
from dpcli.store.parts import PartsSample

_FEWEST = 16  # points of a frame; one with fewer is filled up by repeats
_SMALL = 1024  # points of a frame up to which one thread is enough after the network
_TOGETHER = 8  # pairs of frames whose motions are refined at once
_SPREAD = 8  # farthest points are searched among this many times the wanted number, drawn at random

Estimate = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # (N,3), (M,3) -> flow forth (N,3) and back (M,3)
Flows = dict[tuple[int, int], Tensor]  # from one frame to another, by their numbers
Segmenter = Callable[[list[Tensor], Flows], list[Tensor]]  # frames, flows -> masks (N,S)


@dataclass(frozen=True)
class Refinement:
    """points: most points of a frame that the segmenter sees. pairs: adjacent or all. icp: steps of object-aware ICP.
    vote: blend each frame's mask with its neighbors' carried along the flow. smallest: parts below this share of a
    sequence's points are given to each point's next best part."""

    points: int = 512
    pairs: str = "adjacent"
    icp: int = 20
    vote: bool = True
    smallest: float = 0.03
    normalize: bool = True
    split: bool = True  # slots whose points move apart are divided, see `split_by_motion`


def network_segmenter(model: PartNetwork, device: torch.device) -> Segmenter:
    """Masks of the part network, frame by frame or together where frames have equally many points."""
    return _NetworkSegmenter(model, device)


@dataclass(frozen=True)
class _NetworkSegmenter:
    """Looks at no flow, so `predict_parts` may call it while the flows are still being found."""

    model: PartNetwork
    device: torch.device

    @torch.inference_mode()
    def __call__(self, frames: list[Tensor], flows: Flows) -> list[Tensor]:
        if len({len(frame) for frame in frames}) == 1:
            chunks = torch.stack(frames).split(8)
            return [mask.cpu() for chunk in chunks for mask in self.model(chunk.to(self.device)).mask]
        return [self.model(frame[None].to(self.device)).mask[0].cpu() for frame in frames]


def needs_flows(frames: int, pairs: str) -> list[tuple[int, int]]:
    """(source, target) frames to report: adjacent ones forward, or every ordered pair."""
    if pairs == "all":
        return [(i, j) for i in range(frames) for j in range(frames) if i != j]
    return [(t, t + 1) for t in range(frames - 1)]


def predict_parts(
    sequence: CloudSequence, index: int, segmenter: Segmenter, estimate: Estimate, options: Refinement, seed: int
) -> tuple[np.ndarray, PartsSample]:
    """Hard ids i16 (P), the same id for the same part in all frames, and what else is said of the sequence.

    Frames are thinned to `points`, centered and scaled together to diameter 1 (so no unit or place matters); masks are
    carried back to all points from the three nearest. One frame gives parts and no motion. Frames without points are
    left out of everything: their neighbors are each other's, and what leads from or to them stands still.
    """
    clouds = [np.float32(sequence.frame(t)) for t in range(sequence.num_frames)]
    seen = [t for t, cloud in enumerate(clouds) if len(cloud)] or [0]
    center = np.float32(np.concatenate([c for c in clouds if len(c)] or [np.zeros((1, 3))]).mean(0))
    scale = np.float32(sequence_scale([c for c in clouds if len(c)])) if options.normalize else np.float32(1)
    whole = [torch.from_numpy((clouds[t] - center) * scale) for t in seen]
    thin = [_thinned(cloud, options.points, generator(seed, index, t)) for t, cloud in zip(seen, whole)]
    wanted, place = needs_flows(len(clouds), options.pairs), {t: number for number, t in enumerate(seen)}
    pairs = [(place[i], place[j]) for i, j in wanted if i in place and j in place]
    chain = [(t, t + 1) for t in range(len(thin) - 1)]
    flows, masks = _flows_and_masks(thin, [*pairs, *chain], estimate, segmenter)
    if options.split and len(thin) > 1:
        with torch_threads(_threads_for(thin)):
            masks = [
                split_by_motion(cloud, flows[t, t + 1 if t + 1 < len(thin) else t - 1], mask)
                for t, (cloud, mask) in enumerate(zip(thin, masks))
            ]
    masks = _consistent(thin, flows, masks, options.vote)
    masks = _without_crumbs(masks, options.smallest)
    full = [_carried_back(cloud, few, mask) for cloud, few, mask in zip(whole, thin, masks)]
    labels = np.concatenate([mask.argmax(1).numpy() for mask in full]).astype(np.int16)
    probability = torch.cat(full).numpy().astype(np.float32)
    motion, flow = _motions(thin, whole, masks, full, flows, pairs, options, float(scale), center)
    if len(pairs) < len(wanted):
        motion, flow = _with_empty_frames(wanted, [(seen[i], seen[j]) for i, j in pairs], clouds, motion, flow)
    return labels, PartsSample(probability, np.array(wanted, np.int32).reshape(-1, 2), motion, flow)


def _with_empty_frames(
    wanted: list[tuple[int, int]],
    known: list[tuple[int, int]],
    clouds: list[np.ndarray],
    motion: np.ndarray,
    flow: list[np.ndarray],
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Motions (Q,S,4,4) and flows of all wanted pairs: what is not known stands still."""
    every = np.tile(np.eye(4, dtype=np.float32), (len(wanted), motion.shape[1], 1, 1))
    flows = [np.zeros_like(clouds[i]) for i, _ in wanted]
    place = {pair: number for number, pair in enumerate(wanted)}
    for pair, one, own in zip(known, motion, flow):
        every[place[pair]], flows[place[pair]] = one, own
    return every, flows


def _thinned(cloud: Tensor, wanted: int, rng: np.random.Generator) -> Tensor:
    if len(cloud) == 0:
        return torch.zeros(_FEWEST, 3)
    if len(cloud) <= wanted:
        return cloud if len(cloud) >= _FEWEST else cloud[choose_points(len(cloud), _FEWEST, rng)]
    some = cloud[np.sort(choose_points(len(cloud), min(len(cloud), _SPREAD * wanted), rng))]
    return some[fps(some[None], wanted)[0]]


def _flows_and_masks(
    frames: list[Tensor], pairs: list[tuple[int, int]], estimate: Estimate, segmenter: Segmenter
) -> tuple[Flows, list[Tensor]]:
    """All flows wanted, of every two frames both ways at once, and the masks.

    Two threads: beside the pairs of frames, which come one after the other, the network if that is what says the masks.
    """
    both = sorted({(min(pair), max(pair)) for pair in pairs})
    workers = min(2, torch.get_num_threads())  # one of torch's threads in each: what is set now holds for new ones
    with torch_threads(_threads_for(frames)), ThreadPoolExecutor(workers) as pool:
        early = pool.submit(segmenter, frames, {}) if isinstance(segmenter, _NetworkSegmenter) else None
        found = list(pool.map(lambda pair: estimate(frames[pair[0]], frames[pair[1]]), both))
        flows = dict(zip(both, (forth for forth, _ in found)))
        flows |= {(j, i): back for (i, j), (_, back) in zip(both, found)}
        return flows, early.result() if early else segmenter(frames, flows)


def _consistent(frames: list[Tensor], flows: Flows, masks: list[Tensor], vote: bool) -> list[Tensor]:
    """Slots in frame 0's order in every frame, and each mask averaged with its neighbors' as the flow brings them."""
    if len(frames) == 1:
        return masks
    chain = [flows[t, t + 1] for t in range(len(frames) - 1)]
    orders = match_sequence(frames, chain, masks)
    masks = [mask[:, order] for mask, order in zip(masks, orders)]
    if not vote:
        return masks
    voted = []
    for t, mask in enumerate(masks):
        total, count = 2 * mask, 2
        for u in (t - 1, t + 1):
            if 0 <= u < len(masks):
                total = total + carry_mask(frames[u][None], flows[u, t][None], masks[u][None], frames[t][None])[0]
                count += 1
        voted.append(total / count)
    return voted


def _without_crumbs(masks: list[Tensor], smallest: float) -> list[Tensor]:
    """Slots with less than `smallest` of the sequence's points lose them, unless that were all."""
    share = torch.cat([one_hot(mask) for mask in masks]).mean(0)
    kept = (share >= smallest).float()
    if kept.sum() == 0:
        return masks
    return [(mask * kept + 1e-12 * kept) / (mask * kept + 1e-12 * kept).sum(1, keepdim=True) for mask in masks]


def _carried_back(cloud: Tensor, thin: Tensor, mask: Tensor) -> Tensor:
    """The mask (n,S) of thin points (n,3) at all points of the cloud (N,3)."""
    if len(cloud) == 0:
        return mask[:0]
    if cloud.shape == thin.shape and torch.equal(cloud, thin):
        return mask
    spread = torch.cat([three_nn_interpolate(part[None], thin[None], mask[None])[0] for part in cloud.split(1 << 16)])
    return spread / spread.sum(1, keepdim=True).clamp(min=1e-12)


def _motions(
    thin: list[Tensor],
    whole: list[Tensor],
    masks: list[Tensor],
    full: list[Tensor],
    flows: Flows,
    pairs: list[tuple[int, int]],
    options: Refinement,
    scale: float,
    center: np.ndarray,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Motion f32 (Q,S,4,4) in the input's own coordinates and flow of all points, pair by pair."""
    slots = masks[0].shape[1]
    motion, flow = np.tile(np.eye(4, dtype=np.float32), (len(pairs), slots, 1, 1)), []
    middle = torch.from_numpy(center)
    with torch_threads(_threads_for(thin)):
        fitted = _fitted(thin, masks, flows, pairs, options.icp)
    for q, ((i, _), (rotation, shift)) in enumerate(zip(pairs, fitted)):
        flow.append((rigid_flow(whole[i][None], full[i][None], rotation[None], shift[None])[0] / scale).numpy())
        used = one_hot(masks[i]).sum(0) > 0
        own = shift / scale + middle - (rotation @ middle)
        motion[q] = torch.where(used[:, None, None], to_matrix(rotation, own), torch.eye(4)).numpy()
    return motion, flow


def _threads_for(frames: list[Tensor]) -> int:
    """Returns how many of torch's threads to use: one for small frames, of whose operations two threads gain nothing."""
    return 1 if max(len(frame) for frame in frames) <= _SMALL else torch.get_num_threads()


def _fitted(
    thin: list[Tensor], masks: list[Tensor], flows: Flows, pairs: list[tuple[int, int]], steps: int
) -> list[tuple[Tensor, Tensor]]:
    """Motions (S,3,3), (S,3) of every pair of frames; pairs of equally many points together, `_TOGETHER` at a time."""
    found: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
    alike: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for i, j in pairs:
        alike.setdefault((len(thin[i]), len(thin[j])), []).append((i, j))
    for group in alike.values():
        for start in range(0, len(group), _TOGETHER):
            some = group[start : start + _TOGETHER]
            first, second = (torch.stack([own[pair[side]] for pair in some]) for own, side in ((thin, 0), (thin, 1)))
            mask1, mask2 = (torch.stack([masks[pair[side]] for pair in some]) for side in (0, 1))
            rotation, shift = _fit(first, second, mask1, mask2, torch.stack([flows[pair] for pair in some]), steps)
            found |= {pair: (r, t) for pair, r, t in zip(some, rotation, shift)}
    return [found[pair] for pair in pairs]


def _fit(
    first: Tensor, second: Tensor, mask1: Tensor, mask2: Tensor, flow: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Motions (B,S,3,3), (B,S,3) by object-aware ICP from the flow; whichever of before and after lies nearer to frame 2."""
    start = weighted_kabsch(first, first + flow, mask1)
    if steps == 0:
        return start
    same = torch.arange(mask1.shape[2]).expand(len(first), -1)
    _, rotation, shift = object_icp(first, second, mask1, mask2, flow, steps, 0.01, same)
    gaps = [_gap(first, second, mask1, *found) for found in (start, (rotation, shift))]  # [B, S] each
    better = gaps[1] <= gaps[0]
    return (torch.where(better[..., None, None], rotation, start[0]), torch.where(better[..., None], shift, start[1]))


def _gap(first: Tensor, second: Tensor, mask1: Tensor, rotation: Tensor, shift: Tensor) -> Tensor:
    """Mean distance (B,S) of each part's own points, moved, to frame 2."""
    share = one_hot(mask1)  # [B, N, S]
    squared, _ = knn(first + rigid_flow(first, share, rotation, shift), second, 1)
    return (share * squared.sqrt()).sum(1) / share.sum(1).clamp(min=1)
