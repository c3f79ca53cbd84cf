"""A network for sparse clouds, such as a radar's: the points of each slot of time become one feature, and layers over
time read the slots in their order.

A slot is a set of points as PointNet (Qi et al., 2017) reads it. A few points say little about a surface, so this backbone
has no neighborhoods and nothing that a dynamic stream could fit: what moves how is in the points' columns (a radar's
Doppler speed) and in the order of the slots.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpcli.classify.network.backbones.interface import Backbone, Grouping, Stage
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.descriptors import LEVELS, clip_descriptors
from dpcli.classify.network.forest import Forest
from dpcli.classify.network.layers import ClipLinear, RowNorm
from dpcli.classify.network.sync_norm import has_synchronized_norms
from dpcli.errors import UsageError

_REACH = 3  # slots that a layer over time sees
_STEPS = (1, 2, 4)  # between these slots, a layer each
_DROPPED = 0.1  # after each layer over time
_LEAST = 1e-12  # the probability that 0 is taken for
_READ = 16  # numbers of each slot that are read at its place in the video
_COPIES = 4  # of a clip: as it is, mirrored, reversed in time, and both


class PointSlots(Backbone):
    """Classifies by the mean of `members` equal networks.

    In training each learns from its own share of a batch, so that all of them cost what one network costs; their errors
    differ, and the mean of their scores has fewer. Beside each stands a forest on descriptors of the videos that it learned
    from: another kind of errors. A clip may be marked with the member that must not learn from it; that member alone
    classifies it then: so all videos train, and all are judged by a network that never saw them. Reads of the
    config: num_frames (slots), points_per_frame, widths (the layers of a point; the width of a slot), columns, members,
    copies, slot_details, dropout.
    """

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        self.config, self.tap_widths = config, ()
        self.members = nn.ModuleList(_Member(config) for _ in range(config.members))
        self.register_buffer("forest_share", torch.tensor(0.0))  # of the logarithm of a score

    def group(self, points: Tensor, times: Tensor) -> list[Grouping]:
        """Returns the points (B,N,3) as they are: one grouping without neighborhoods."""
        nothing = times.new_zeros((len(points), 0, 0), dtype=torch.long)
        return [Grouping(points, times, points[:, :0], times[:, :0], nothing)]

    def forward(self, groups: list[Grouping]) -> Tensor:
        """Returns class logits (B,C): the logarithm of the mean scores of the members that `_voting_members` names.

        All classes are alike for a clip without any point.
        """
        clips = torch.cat([groups[0].points, groups[0].columns], -1)
        clips = clips.unflatten(1, (self.config.num_frames, self.config.points_per_frame))
        voting = self._voting_members(clips[..., 3].amax((1, 2)).long() - 2)
        total = clips.new_zeros(len(clips), self.config.num_classes)
        for member, asked in zip(self.members, voting.T):
            if asked.any() or (self.training and has_synchronized_norms(member)):
                which = asked.nonzero()[:, 0]
                scores = member.scores(clips[which], self.forest_share, self.training)
                total = total.index_add(0, which, scores.to(total))
        logits = torch.log(total.clamp(min=_LEAST) / voting.sum(1, keepdim=True))
        empty = (clips[..., 3] == 0).flatten(1).all(1, keepdim=True)
        return torch.where(empty & (not self.training), torch.zeros_like(logits), logits)

    def _voting_members(self, unseen: Tensor) -> Tensor:
        """Returns which members classify which clip, bool (B,K): in training one of them, not the one that must not see it;
        else that one, or all where a clip has no mark.

        unseen: the members that must not see the clips, i64 (B), below 0 where there is none.
        """
        count, marked = len(self.members), unseen >= 0
        everyone = torch.arange(count, device=unseen.device)
        if not self.training:
            return (everyone == unseen[:, None]) | ~marked[:, None]
        turn = torch.arange(len(unseen), device=unseen.device)
        others = (unseen + 1 + turn % max(count - 1, 1)) % count
        return everyone == torch.where(marked, others, turn % count)[:, None]

    def taps(self, groups: list[Grouping]) -> tuple[list[Stage], Tensor]:
        """Raises UsageError: there are no neighborhoods to look at."""
        raise UsageError(
            "a network for sparse clouds (backbone slots) has no neighborhoods and no dynamic stream, so it predicts but can't be"
            " explained; `dpc classify train --preset quick` trains one that can"
        )


class _Member(nn.Module):
    """Classifies clips (B,T,P,5+F): place, more than 0 where there is a point, time within the slot, columns.

    With `copies` it learns from mirrored and reversed clips, too, as self-supervised label augmentation does (Lee et al.,
    2020): what a gesture becomes by them is not in a file, so each kind of copy has a classifier of its own, while all share
    the layers below, which thus see four times as many movements.

    With `slot_details` it also sees quantiles of each slot's values, which a few points far off don't change as they do a mean or
    a maximum, and its classifier reads a few numbers of each slot at its place in the video: the mean and the maximum over
    all slots forget when something happened. Speeds in the columns make up for it, places alone don't.
    """

    def __init__(self, config: KinetConfig) -> None:
        super().__init__()
        first, second = config.widths[0]
        width = config.widths[1][0]
        self.points = nn.Sequential(*_layer(4 + len(config.columns), first), *_layer(first, second))
        quantiles = len(LEVELS) * (3 + len(config.columns)) if config.slot_details else 0
        self.slots = nn.Sequential(*_layer(2 * second + 1 + quantiles, width))
        self.position = nn.Parameter(torch.zeros(config.num_frames, width))
        self.over_time = nn.ModuleList(_TemporalConvolution(width, step) for step in _STEPS)
        self.copies, self.speeds = _COPIES if config.copies else 1, config.signed_columns
        self.dropout = nn.Dropout(config.dropout)
        self.course = nn.Linear(width, _READ) if config.slot_details else None
        read = _READ * config.num_frames if config.slot_details else 0
        self.classify = ClipLinear(2 * width + read, self.copies * config.num_classes)
        self.forest = Forest(*config.forest, config.num_classes)
        nn.init.trunc_normal_(self.classify.weight, std=0.01)  # the first steps shall not have to unlearn large ones

    def scores(self, clips: Tensor, share: Tensor, training: bool = False) -> Tensor:
        """Returns the probabilities (B,C): in training of one copy of each clip, drawn at random; else the mean over all copies,
        and the geometric mean of it and, with its share, the forest's.

        training: whether the network learns; where that is a last layer alone, the member itself is in evaluation mode.
        """
        if training:
            kinds = torch.randint(self.copies, (len(clips),)).to(clips.device)
            return torch.softmax(self(self._copied(clips, kinds), kinds), -1)
        total = clips.new_zeros(len(clips), self.forest.classes)
        for kind in range(self.copies):
            kinds = torch.full((len(clips),), kind, device=clips.device)
            total = total + torch.softmax(self(self._copied(clips, kinds), kinds), -1)
        logits = torch.log((total / self.copies).clamp(min=_LEAST))
        if share > 0:
            described = torch.from_numpy(clip_descriptors(clips.cpu().numpy())).to(clips.device)
            logits = (1 - share) * logits + share * torch.log(self.forest(described))
        return torch.softmax(logits, -1)

    def _copied(self, clips: Tensor, kinds: Tensor) -> Tensor:
        """Returns the copies of clips (B,T,P,5+F) of the kinds i64 (B): 0 as it is, 1 mirrored, 2 reversed, 3 both.

        Reversed, every speed has the other sign.
        """
        if self.copies == 1:
            return clips
        signs = clips.new_ones(2, clips.shape[-1])
        signs[0, 0] = -1
        signs[1, [4, *(5 + place for place in self.speeds)]] = -1
        mirrored, reverse = (kinds % 2 == 1)[:, None, None, None], (kinds >= 2)[:, None, None, None]
        clips = torch.where(mirrored, clips * signs[0], clips)
        return torch.where(reverse, clips.flip(1) * signs[1], clips)

    def forward(self, clips: Tensor, kinds: Tensor) -> Tensor:
        """Returns the logits (B,C) of the layers alone, of clips that are copies of the kinds i64 (B)."""
        here = clips[..., 3].flatten().nonzero()[:, 0]
        known = self.points(torch.cat([clips[..., :3], clips[..., 4:]], -1).flatten(0, 2).index_select(0, here))
        values = known.new_zeros(clips[..., 3].numel(), known.shape[-1]).index_copy(0, here, known)
        values, count = values.view(*clips.shape[:3], known.shape[-1]), (clips[..., 3:4] > 0).sum(2).to(values)
        pooled = [values.sum(2) / count.clamp(min=1), values.amax(2), torch.log1p(count)]  # values are not below 0
        if self.course is not None:
            pooled.append(slot_quantiles(clips))
        found = (
            self.slots(torch.cat(pooled, -1).flatten(0, 1)).view(*count.shape[:2], self.position.shape[-1])
            + self.position
        )
        for layer in self.over_time:
            found = found + layer(found)
        read = [found.mean(1), found.amax(1)]
        if self.course is not None:
            read.append(self.course(found).flatten(1))
        logits = self.classify(self.dropout(torch.cat(read, -1)))
        return logits.unflatten(-1, (self.copies, -1))[torch.arange(len(clips), device=clips.device), kinds]


def slot_quantiles(clips: Tensor) -> Tensor:
    """Returns five quantiles of the places and columns of each slot's points, f32 (B,T,5(3+F)), of clips (B,T,P,5+F); 0 where a
    slot has no point."""
    there = clips[..., 3:4] > 0
    values = torch.cat([clips[..., :3], clips[..., 5:]], -1)
    ordered = torch.where(there, values, values.new_tensor(float("inf"))).sort(2).values
    last = there.sum(2, keepdim=True) - 1
    places = torch.cat([(level * last.clamp(min=0)).round().long() for level in LEVELS], 2)
    found = ordered.gather(2, places.expand(-1, -1, -1, values.shape[-1]))
    return torch.where(last >= 0, found, torch.zeros_like(found)).flatten(2)


class _TemporalConvolution(nn.Module):
    """Reads each slot together with the slots before and after it, `step` apart: (B,T,W) to the same shape."""

    def __init__(self, width: int, step: int) -> None:
        super().__init__()
        self.mix = nn.Conv1d(width, width, _REACH, padding=step * (_REACH // 2), dilation=step)
        self.norm, self.dropout = RowNorm(width), nn.Dropout(_DROPPED)

    def forward(self, slots: Tensor) -> Tensor:
        """Returns what is added to the slots."""
        mixed = self.mix(slots.transpose(1, 2)).transpose(1, 2)
        return self.dropout(torch.relu(self.norm(mixed.flatten(0, 1)).view_as(mixed)))


def _layer(inputs: int, outputs: int) -> tuple[nn.Module, ...]:
    return nn.Linear(inputs, outputs), RowNorm(outputs), nn.ReLU()
