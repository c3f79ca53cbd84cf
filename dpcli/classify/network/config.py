"""The settings of a Kinet's network and input: every choice that shapes it, in one value that travels with the weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Literal

from dpcli.errors import UsageError
from dpcli.runtime.settings.fields import WIDEST, Settings, setting
from dpcli.runtime.settings.stored import from_json
from dpcli.store.schema import kept_name

CROSS = "cross"  # the rule of validation by which every video is judged by members that never saw it

# what the published code does: groups of 3 features, a group of raw coordinates, absolute time, weights by projection, a merge
# across scales, averaged logits
RELEASE = {
    "variant": "release",
    "group_size": 3,
    "xyz_group": True,
    "time_input": True,
    "weighting": "projection",
    "merge": "cross",
    "guard": "release",
    "fusion": "logits",
    "grouping": "first",
}
_MOST_POINTS = 1 << 22  # of a clip: 85 times those of the thesis


@dataclass(frozen=True)
class KinetConfig(Settings):
    """Holds the settings of a Kinet. The defaults are the thesis's text, but for `static_temporal_radius`: the preset `thesis`
    says 0, and models made before it was a choice have None. `release()` gives the published code's choices.

    Lengths are in the input's unit after normalization, times in frames. Raises UsageError for values that don't fit.
    """

    num_classes: int = 20  # follows from the data, so that it is no setting
    num_frames: int = setting(16, "Frames per clip.", least=1, name="frames")
    points_per_frame: int = setting(2048, "Points drawn per frame.", least=1, name="points")
    normalize: Literal["none", "center", "height", "unit", "image"] = setting(
        "none",
        "Coordinates of a clip: as they are (none); their mean at 0 (center); and every body equally tall, y upright (height);"
        " or within radius 1 (unit); or rows, columns and depth of gestures (image).",
    )
    variant: Literal["thesis", "release"] = setting(
        "thesis",
        "Whether the thesis's text or its published code decides where they disagree: changes group_size, xyz_group, time_input,"
        " weighting, merge, guard, fusion, grouping and static_temporal_radius together.",
    )
    backbone: str = setting(
        "pointnet2",
        "Static network: pointnet2, dgcnn, spidercnn, slots (for sparse clouds, without a dynamic stream), or your own as"
        " module:Class (docs/backbones.md). A backbone other than the preset's changes the sizes, too.",
    )
    centroids: tuple[int, int] = setting(
        (1024, 512),
        "Neighborhoods of a clip in the two stages of pointnet2. No weight depends on their number: train with few first, then"
        " with the preset's by --init.",
        least=1,
    )
    neighbors: int = setting(
        64, "Points of a neighborhood. No weight depends on their number, except with the backbone spidercnn.", least=1
    )
    radii: tuple[float, float] = setting(
        (0.5, 1.0),
        "Spatial radii of the neighborhoods in the two stages at time distance 0, in the input's unit.",
        above=0,
        name="radius",
    )
    temporal_radius: int = setting(1, "Frames before and after that count as neighbors.", least=0)
    static_temporal_radius: int | None = setting(
        None,
        "Frames before and after that count as neighbors in the static stream alone (pointnet2): 0 keeps its neighborhoods"
        " within a frame, so that it sees no motion; none: as temporal_radius, with one set of neighborhoods for both streams.",
        least=0,
    )
    grouping: Literal["first", "nearest", "balanced"] = setting(
        "balanced",
        "Neighbors taken within the radius: the first found, the nearest, or equal shares of each frame (balanced).",
    )
    widths: tuple[tuple[int, ...], ...] = setting(
        ((64, 128), (128, 256), (512, 1024)),
        "Widths of the backbone's layers, a group for each stage.",
        least=1,
        most=WIDEST,
    )
    head: tuple[int, int] | None = setting(
        None, "Widths of the dynamic branch's head; none: the last group of widths.", least=1, most=WIDEST
    )
    group_size: int = setting(4, "Features per fitted surface, d of eq. 3.5.", least=1, most=WIDEST)
    reduction: float = setting(
        0.5, "Width of the fitted features as a share of the static layer's width.", above=0, most=1
    )
    xyz_group: bool = setting(False, "Fit one more surface, to the neighbors' relative coordinates.")
    time_input: bool = setting(False, "Reduce the frame's number together with the static feature.")
    weighting: Literal["deviation", "projection", "none"] = setting(
        "deviation",
        "Weights of the neighbors in a fit: by eq. 3.8 (deviation), as in the published code (projection), or all 1 (none;"
        " row vi of table 3.1).",
    )
    normals: bool = setting(
        True, "Fit surfaces; false (row v of table 3.1) pools the reduced features instead, without weights."
    )
    merge: Literal["residual", "cross"] = setting(
        "residual",
        "How surface normals of all layers become one feature: as in figure 3.4 (residual), or exchanged between both stages"
        " by interpolation, as in the published code (cross).",
    )
    merge_norm: bool = setting(
        False, "Batch norm in the residual merge: not in the thesis, but it trains in a fraction of the epochs."
    )
    solver: Literal["inverse", "ridge"] = setting(
        "inverse",
        "Solver of the surface fit: the closed form of A.1.1 (inverse), or with a term on the diagonal that needs no guard"
        " (ridge).",
    )
    guard: Literal["signed", "release"] = setting(
        "signed",
        "What replaces a determinant near 0 in the closed form: 1e-6 with its sign, or as in the published code.",
    )
    fusion: Literal["softmax", "logits"] = setting(
        "softmax", "What is averaged over both streams: probabilities (softmax, the thesis), or logits."
    )
    dropout: float = setting(0.0, "Dropout before each head's last layer.", least=0, below=1)
    members: int = setting(1, "Networks whose scores are averaged (backbone slots).", least=1, most=64)
    copies: bool = setting(
        False,
        "Train also on mirrored and time-reversed copies of a clip, each kind with a classifier of its own, and average"
        " their scores (backbone slots).",
    )
    slot_details: bool = setting(
        False,
        "Classify also by quantiles of each slot of time, and by each slot at its place in the video, not by means and maxima over"
        " all of them alone (backbone slots).",
    )
    columns: tuple[str, ...] = ()  # what the file keeps of a point that the backbone slots reads; follows from the data
    # trees and nodes of a tree beside each member of the backbone slots, grown from the data
    forest: tuple[int, int] = (0, 0)
    scales: tuple[float, ...] = ()  # unit of length, then middle and spread of each column; follow from the data

    def __post_init__(self) -> None:
        if self.num_classes < 1:
            raise UsageError(f"number of classes {self.num_classes}: expected at least 1")
        super().__post_init__()
        if self.num_frames * self.points_per_frame > _MOST_POINTS:
            raise UsageError(
                f"{self.num_frames} frames x {self.points_per_frame} points: expected at most {_MOST_POINTS} points in a clip"
            )
        if self.backbone == "slots":
            self._check_columns()
            return
        for name, plain in (("members", 1), ("copies", False), ("slot_details", False)):
            if getattr(self, name) != plain:
                raise UsageError(
                    f"{name} = {str(getattr(self, name)).lower()}: only the backbone slots has it; leave it out, or take --preset"
                    " sparse"
                )
        if self.backbone == "pointnet2":
            self._check_centroids()
        if self.xyz_group and self.group_size < 3:
            raise UsageError(
                f"group_size = {self.group_size}: one group holds the three coordinates (presets quick, tiny, release);"
                " expected at least 3, or --preset thesis"
            )
        if self.own_static_groups and self.backbone != "pointnet2":
            raise UsageError(
                f"static_temporal_radius = {self.static_radius}: {self.backbone}'s one graph serves both streams; leave it out"
            )
        self._check_reach("temporal_radius", self.temporal_radius)
        self._check_reach("static_temporal_radius", self.static_radius)

    @property
    def column_fields(self) -> tuple[str, ...]:
        """Returns the names of the columns as fields of a clouds file."""
        return tuple(map(kept_name, self.columns))

    @property
    def signed_columns(self) -> list[int]:
        """Returns the places of the columns that are speeds: their middle is 0."""
        return [place for place, middle in enumerate(self.scales[1::2]) if middle == 0]

    def _check_reach(self, name: str, radius: int) -> None:
        """Raises UsageError unless the frames of a neighborhood have a slot each, and points for all slots."""
        reach = 2 * radius + 1
        if self.grouping == "balanced" and self.neighbors < reach:
            raise UsageError(
                f"{name} = {radius}: balanced grouping shares {self.neighbors} neighbors among {reach} frames"
            )
        near = min(reach, self.num_frames) * self.points_per_frame
        if self.neighbors > near:
            raise UsageError(f"neighbors = {self.neighbors}: the frames within {name} = {radius} hold {near} points")

    def _check_columns(self) -> None:
        if min(self.forest) < 0:
            raise UsageError(f"forest = {self.forest}: expected the numbers of trees and of nodes")
        if self.scales and (len(self.scales) != 1 + 2 * len(self.columns) or min(self.scales[0::2]) <= 0):
            raise UsageError(
                f"scales = {self.scales}: expected a unit, and middle and spread of each of {self.columns}"
            )
        if len(self.widths) != 2 or [len(one) for one in self.widths] != [2, 1]:
            raise UsageError(f"widths = {self.widths}: expected two of a point's layers and a slot's, as in 64,64/128")

    def _check_centroids(self) -> None:
        first, second = self.centroids
        if second > first:
            raise UsageError(f"centroids = {first},{second}: expected two counts, the second not above the first")
        have = self.points_per_frame * self.num_frames
        if have < first:
            raise UsageError(
                f"{self.num_frames} frames x {self.points_per_frame} points = {have} are fewer than {first} centroids"
            )

    @property
    def static_radius(self) -> int:
        """Returns the number of frames before and after that the static stream's neighborhoods reach."""
        return self.temporal_radius if self.static_temporal_radius is None else self.static_temporal_radius

    @property
    def own_static_groups(self) -> bool:
        """Returns whether the static stream has neighborhoods of its own."""
        return self.static_radius != self.temporal_radius

    @property
    def dynamic_head(self) -> tuple[int, int]:
        """Returns the widths of the two layers of the dynamic branch's head."""
        return self.head or self.widths[-1]

    @classmethod
    def release(cls, **changes: object) -> KinetConfig:
        """Returns the published code's choices, `RELEASE`, with changes over them."""
        return cls(**{**RELEASE, **changes})

    def changed(self, **changes: object) -> KinetConfig:
        """Returns a copy with some fields changed. Raises UsageError where they don't fit."""
        return replace(self, **changes)

    def radius_table(self, stage: int, reach: int) -> tuple[float, ...]:
        """Returns the spatial radius at each time distance d = 0..reach, r (1 + 0.2 d / (T-1)) with r of the stage, as the published
        code does."""
        growth = 0.2 * self.radii[stage] / max(self.num_frames - 1, 1)
        return tuple(self.radii[stage] + growth * d for d in range(reach + 1))

    def groups(self, width: int) -> int:
        """Returns the number of feature groups that are fitted at a layer of this width, the group of coordinates included."""
        if self.xyz_group:
            return int(width * self.reduction / self.group_size) + 1
        return max(1, round(width * self.reduction / self.group_size))

    def to_json(self) -> str:
        """Returns all fields as JSON text with sorted keys, as weights files hold them."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> KinetConfig:
        """Returns the configuration that `to_json` wrote. Raises DataError as `stored.from_json`."""
        return from_json(cls, text)
