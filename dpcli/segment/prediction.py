"""The parts of one sequence and their motions: a segmenter gives masks of thinned frames, the rest is the same for all."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dpcli.ops import fps, three_nn_interpolate
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.runtime.tuning import torch_threads
from dpcli.segment.frame_pairs import choose_points, first_copies, sequence_scale, without_strays
from dpcli.segment.multibody.segmenter import MultibodySegmenter
from dpcli.segment.network.slot_matching import carry_mask, match_slots_through_frames, one_hot
from dpcli.segment.part_motions import Pairs, fit_part_motions, motion_in_input_units, part_flow, threads_for
from dpcli.segment.prediction_settings import Refinement
from dpcli.segment.segmenters import Flows, FrameSegmenter
from dpcli.segment.split_by_motion import split_by_motion
from dpcli.store import CloudSequence
from dpcli.store.parts import PartsSample

_FEWEST = 16  # points of a frame; one with fewer is filled up by repeats
_SPREAD = 8  # farthest points are searched among this many times the wanted number, drawn at random
_CHUNK = 1 << 16  # points that get their mask back at a time

Estimate = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]  # (N,3), (M,3) -> flow forth (N,3) and back (M,3)


@dataclass
class _Frames:
    """Holds the frames of a sequence that have points, centered and scaled together: whole, and thinned."""

    numbers: list[int]
    whole: list[Tensor]
    thin: list[Tensor]
    scale: float
    center: np.ndarray
    tracks: list[np.ndarray] | None = None  # of frames that are whole, not thinned


def predict_parts(
    sequence: CloudSequence,
    segmenter: FrameSegmenter | MultibodySegmenter,
    estimate: Estimate,
    options: Refinement,
    seed: int,
) -> tuple[np.ndarray, PartsSample]:
    """Returns hard ids i16 (P), the same id for the same part in all frames, and what else is said of the sequence.

    seed: of the draws by which frames are thinned to `points`. They are centered and scaled together to
    diameter 1 (so no unit or place matters); masks are carried back to all points from the three nearest. One frame gives
    parts and no motion. Frames without points are left out of everything: their neighbors are each other's, and what
    leads from or to them stands still.
    """
    clouds = [np.float32(sequence.frame(t)) for t in range(sequence.num_frames)]
    tracks = _tracks_of(sequence) if isinstance(segmenter, MultibodySegmenter) and segmenter.by_tracks else None
    frames = _prepare_frames(clouds, options, seed, tracks)
    reported, place = pairs_to_report(len(clouds), options.pairs), {t: n for n, t in enumerate(frames.numbers)}
    known = [q for q, (i, j) in enumerate(reported) if i in place and j in place]
    pairs = [(place[i], place[j]) for i, j in (reported[q] for q in known)]
    masks, motions = _find_masks_and_motions(frames, pairs, segmenter, estimate, options, sequence.name)
    full = masks
    if frames.tracks is None:
        full = [_carry_back(cloud, few, mask) for cloud, few, mask in zip(frames.whole, frames.thin, masks)]
    labels = np.concatenate([mask.argmax(1).numpy() for mask in full]).astype(np.int16)
    motion = np.tile(np.eye(4, dtype=np.float32), (len(reported), masks[0].shape[1], 1, 1))
    flow = [np.zeros_like(clouds[i]) for i, _ in reported]
    for q, (i, _), own in zip(known, pairs, motions):
        motion[q] = motion_in_input_units(own, masks[i], frames.scale, torch.from_numpy(frames.center))
        flow[q] = part_flow(frames.whole[i], full[i], own, frames.scale)
    probability = torch.cat(full).numpy().astype(np.float32)
    return labels, PartsSample(probability, np.array(reported, np.int32).reshape(-1, 2), motion, flow)


def pairs_to_report(frames: int, pairs: str) -> Pairs:
    """Returns the (source, target) frames whose motion is reported: adjacent ones forward, or every ordered pair.

    >>> pairs_to_report(3, "adjacent")
    [(0, 1), (1, 2)]
    """
    if pairs == "all":
        return [(i, j) for i in range(frames) for j in range(frames) if i != j]
    return [(t, t + 1) for t in range(frames - 1)]


def _tracks_of(sequence: CloudSequence) -> list[np.ndarray] | None:
    """Returns the identities i64 (N_t) of every frame's points; None without them, and, with a warning, where one stands for
    two places of a frame, or a frame has none of the frame before: these don't tell how all points move.
    """
    if sequence.track is None:
        return None
    tracks, wrong = np.split(sequence.track, sequence.frame_offsets[1:-1]), ""
    filled = [t for t, own in enumerate(tracks) if len(own)]
    for t, before in zip(filled, [None, *filled]):
        identities, counts = np.unique(tracks[t], return_counts=True)
        twice = np.isin(tracks[t], identities[counts > 1])  # the same point twice does no harm
        places = np.unique(np.column_stack([tracks[t], sequence.frame(t)])[twice], axis=0)
        if len(places) > (counts > 1).sum():
            wrong = f"frame {t} has points of the same track at several places"
        elif before is not None and not np.isin(identities, tracks[before]).any():
            wrong = f"frame {t} has no track of frame {before}"
        if wrong:
            log.warn(f"{sequence.name}: its tracks are not used, and motions are searched: {wrong}")
            return None
    return tracks if len(filled) > 1 else None


def _prepare_frames(
    clouds: list[np.ndarray], options: Refinement, seed: int, tracks: list[np.ndarray] | None = None
) -> _Frames:
    """Returns the frames that have points, centered, scaled, and thinned by draws that depend on their numbers alone, so that a
    sequence has the same parts alone and at any place in a file.

    With tracks, all points stay.
    """
    filled = [cloud for cloud in clouds if len(cloud)]
    numbers = [t for t, cloud in enumerate(clouds) if len(cloud)] or [0]
    known = [without_strays(cloud) for cloud in filled] or [np.zeros((1, 3))]
    center = np.float32(np.concatenate(known).mean(0, dtype=np.float64))
    scale = np.float32(sequence_scale(filled)) if options.normalize else np.float32(1)
    whole = [torch.from_numpy((clouds[t] - center) * scale) for t in numbers]
    if tracks is not None:
        return _Frames(numbers, whole, whole, float(scale), center, [tracks[t] for t in numbers])
    known = [without_strays(cloud.numpy()) for cloud in whole]  # the nearest points tell the part of those left out
    thin = [
        _thin(torch.from_numpy(cloud), options.points, generator(seed, SegmentStream.FOUND_POINTS, t))
        for t, cloud in zip(numbers, known)
    ]
    return _Frames(numbers, whole, thin, float(scale), center)


def _thin(cloud: Tensor, most: int, rng: np.random.Generator) -> Tensor:
    """Returns at most so many far-apart points of a cloud, and at least `_FEWEST`.

    A point that a file holds several times is looked at once, since its copies would make the cloud seem denser, and its
    errors smaller, than they are; only too few points are filled up by repeats.
    """
    if len(cloud) == 0:
        return torch.zeros(_FEWEST, 3)
    some = cloud
    if len(cloud) > most:
        some = cloud[np.sort(choose_points(len(cloud), min(len(cloud), _SPREAD * most), rng))]
    some = some[first_copies(some.numpy())]
    if len(some) < _FEWEST:
        return some[choose_points(len(some), _FEWEST, rng)]
    return some[fps(some[None], most)[0]] if len(some) > most else some


def _find_masks_and_motions(
    frames: _Frames,
    pairs: Pairs,
    segmenter: FrameSegmenter | MultibodySegmenter,
    estimate: Estimate,
    options: Refinement,
    name: str,
) -> tuple[list[Tensor], list[tuple[Tensor, Tensor]]]:
    """Returns the masks (N_t,S) and for every pair the motions (S,3,3), (S,3).

    They come from one explanation of all frames, or, pair by pair, from flows and the masks of single frames.
    """
    if isinstance(segmenter, MultibodySegmenter):
        threads, origin = torch.get_num_threads(), tuple(-frames.scale * frames.center)
        with torch_threads(1):
            masks, motions = segmenter.explain(frames.thin, pairs, frames.tracks, origin, threads, name)
        return masks, [motions[pair] for pair in pairs]
    flows, masks = _find_flows_and_masks(frames.thin, pairs, estimate, segmenter)
    masks = _refine_masks(frames.thin, flows, masks, options)
    return masks, fit_part_motions(frames.thin, masks, flows, pairs, options.icp)


def _find_flows_and_masks(
    frames: list[Tensor], pairs: Pairs, estimate: Estimate, segmenter: FrameSegmenter
) -> tuple[Flows, list[Tensor]]:
    """Returns the flows between the frames of the pairs and between neighbors, both ways at once, and the masks.

    Pairs of frames follow one another in one thread; a segmenter that needs no flows works beside them in a second one.
    """
    neighbors = [(t, t + 1) for t in range(len(frames) - 1)]
    both = sorted({(min(pair), max(pair)) for pair in [*pairs, *neighbors]})
    workers = min(2, torch.get_num_threads())  # one of torch's threads in each: what is set now holds for new ones
    with torch_threads(threads_for(frames)), ThreadPoolExecutor(workers) as pool:
        early = None if segmenter.needs_flows else pool.submit(segmenter.segment, frames, {})
        found = list(pool.map(lambda pair: estimate(frames[pair[0]], frames[pair[1]]), both))
        flows = dict(zip(both, (forth for forth, _ in found)))
        flows |= {(j, i): back for (i, j), (_, back) in zip(both, found)}
        return flows, early.result() if early else segmenter.segment(frames, flows)


def _refine_masks(frames: list[Tensor], flows: Flows, masks: list[Tensor], options: Refinement) -> list[Tensor]:
    """Returns the masks with bodies that move apart divided, the same slots in all frames, and small parts given up."""
    if options.split_bodies and len(frames) > 1:
        with torch_threads(threads_for(frames)):
            masks = [
                split_by_motion(cloud, flows[t, t + 1 if t + 1 < len(frames) else t - 1], mask)
                for t, (cloud, mask) in enumerate(zip(frames, masks))
            ]
    if len(frames) > 1:
        orders = match_slots_through_frames(frames, [flows[t, t + 1] for t in range(len(frames) - 1)], masks)
        masks = [mask[:, order] for mask, order in zip(masks, orders)]
        masks = _vote(frames, flows, masks) if options.vote else masks
    return _give_up_small_parts(masks, options.smallest)


def _vote(frames: list[Tensor], flows: Flows, masks: list[Tensor]) -> list[Tensor]:
    """Returns each mask averaged, with twice the weight, with its neighbors' as the flow brings them."""
    voted = []
    for t, mask in enumerate(masks):
        total, count = 2 * mask, 2
        for u in (t - 1, t + 1):
            if 0 <= u < len(masks):
                total = total + carry_mask(frames[u][None], flows[u, t][None], masks[u][None], frames[t][None])[0]
                count += 1
        voted.append(total / count)
    return voted


def _give_up_small_parts(masks: list[Tensor], smallest: float) -> list[Tensor]:
    """Returns the masks without slots that have less than this share of the sequence's points, unless all have."""
    share = torch.cat([one_hot(mask) for mask in masks]).mean(0)
    kept = (share >= smallest).float()
    if kept.sum() == 0:
        return masks
    return [(mask * kept + 1e-12 * kept) / (mask * kept + 1e-12 * kept).sum(1, keepdim=True) for mask in masks]


def _carry_back(cloud: Tensor, thin: Tensor, mask: Tensor) -> Tensor:
    """Returns the mask (n,S) of thin points (n,3) at all points of the cloud (N,3)."""
    if len(cloud) == 0:
        return mask[:0]
    if cloud.shape == thin.shape and torch.equal(cloud, thin):
        return mask
    spread = torch.cat([three_nn_interpolate(part[None], thin[None], mask[None])[0] for part in cloud.split(_CHUNK)])
    return spread / spread.sum(1, keepdim=True).clamp(min=1e-12)
