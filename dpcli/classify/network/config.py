"""Every choice that shapes a Kinet, in one value that travels with the weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace

from dpcli.errors import DataError, UsageError

VARIANTS = ("thesis", "release")


@dataclass(frozen=True)
class KinetConfig:
    """Network and input of a Kinet. Defaults are the thesis's text, but for `static_temporal_radius` (0 there, which the preset
    says; models made before it was a choice have None); `release()` is the published code's choices.

    Lengths are in the input's unit after normalization, times in frames.
    """

    num_classes: int = 20
    num_frames: int = 16
    points_per_frame: int = 2048
    normalize: str = (  # none | center (subtract the clip's mean) | height (and make bodies equally tall)
        "none"  # | unit (center, and divide by the largest radius) | image
    )
    variant: str = "thesis"
    backbone: str = "pointnet2"  # pointnet2 | dgcnn | spidercnn | module:Class of the user's
    centroids: tuple[int, int] = (1024, 512)
    neighbors: int = 64
    radii: tuple[float, float] = (0.5, 1.0)  # at time distance 0
    temporal_radius: int = 1  # frames
    static_temporal_radius: int | None = (
        None  # of the static stream's own neighborhoods; None: one set serves both streams
    )
    grouping: str = (
        "balanced"  # which neighbors within the radius: first | nearest | balanced (equal shares of each frame)
    )
    widths: tuple[tuple[int, ...], ...] = ((64, 128), (128, 256), (512, 1024))  # the backbone's own, a tuple a stage
    # dynamic branch
    head: tuple[int, int] | None = None  # widths of its head; None: the last of `widths`
    group_size: int = 4  # d of eq. 3.5
    reduction: float = 0.5  # c relative to the static width
    xyz_group: bool = False  # one more group: the neighbor's relative coordinates
    time_input: bool = False  # frame index beside the static feature, into the reduction
    weighting: str = "deviation"  # deviation (eq. 3.8) | projection (release) | none (Table 3.1 vi)
    normals: bool = True  # False: Table 3.1 v, the reduced features are pooled instead of fitted
    merge: str = "residual"  # residual (thesis) | cross (release: both scales exchanged by 3-NN interpolation)
    merge_norm: bool = False  # batch norm in the residual merge (ours: trains in a fraction of the epochs)
    solver: str = "inverse"  # inverse (A.1.1) | ridge (ours: relative Tikhonov term, no guard needed)
    guard: str = "signed"  # what a small determinant becomes: signed | release
    fusion: str = "softmax"  # softmax | logits, averaged
    dropout: float = 0.0  # before the last layer of each head

    def __post_init__(self) -> None:
        for name, legal in _LEGAL.items():
            if getattr(self, name) not in legal:
                raise UsageError(f"{name} = {getattr(self, name)!r}: expected one of {', '.join(map(str, legal))}")
        for name, (least, called) in _LEAST.items():
            if getattr(self, name) < least:
                raise UsageError(f"{called} {getattr(self, name)}: expected at least {least}")
        self._check_ranges()
        self._check_sizes()

    def _check_ranges(self) -> None:
        if not 0 < self.reduction <= 1:
            raise UsageError(f"reduction = {self.reduction}: expected a ratio in (0, 1]")
        if not 0 <= self.dropout < 1:
            raise UsageError(f"--dropout {self.dropout}: expected a probability in [0, 1)")
        if not all(0 < radius < float("inf") for radius in self.radii):
            raise UsageError(f"--radius {self.radii[0]}: expected a number above 0")

    def _check_sizes(self) -> None:
        if self.backbone == "pointnet2":
            self._check_centroids()
        if self.xyz_group and self.group_size < 3:
            raise UsageError(
                f"--group-size {self.group_size}: one group holds the three coordinates (presets quick, tiny, release);"
                " expected at least 3, or --preset thesis"
            )
        if self.own_static_groups and self.backbone != "pointnet2":
            raise UsageError(
                f"--static-temporal-radius {self.static_radius}: {self.backbone}'s one graph serves both streams; leave it out"
            )
        self._check_reach("--temporal-radius", self.temporal_radius)
        self._check_reach("--static-temporal-radius", self.static_radius)

    def _check_reach(self, option: str, radius: int) -> None:
        """Whether the frames of a neighborhood have a slot each, and points for all slots."""
        reach = 2 * radius + 1
        if self.grouping == "balanced" and self.neighbors < reach:
            raise UsageError(
                f"{option} {radius}: balanced grouping shares {self.neighbors} neighbors among {reach} frames"
            )
        near = min(reach, self.num_frames) * self.points_per_frame
        if self.neighbors > near:
            raise UsageError(f"--neighbors {self.neighbors}: the frames within {option} {radius} hold {near} points")

    def _check_centroids(self) -> None:
        first, second = self.centroids
        if not 1 <= second <= first:
            raise UsageError(f"--centroids {first} {second}: expected two counts, the second not above the first")
        have = self.points_per_frame * self.num_frames
        if have < first:
            raise UsageError(
                f"{self.num_frames} frames x {self.points_per_frame} points = {have} are fewer than {first} centroids"
            )

    @property
    def static_radius(self) -> int:
        """Frames before and after that the static stream's neighborhoods reach."""
        return self.temporal_radius if self.static_temporal_radius is None else self.static_temporal_radius

    @property
    def own_static_groups(self) -> bool:
        """Whether the static stream has neighborhoods of its own."""
        return self.static_radius != self.temporal_radius

    @property
    def dynamic_head(self) -> tuple[int, int]:
        """Widths of the dynamic branch's head."""
        return self.head or self.widths[-1]

    @classmethod
    def release(cls, **changes: object) -> KinetConfig:
        """The released code: groups of 3, a raw xyz group, absolute time, projection weights, cross-scale merge, logits."""
        choices = {
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
        return cls(**{**choices, **changes})

    def changed(self, **changes: object) -> KinetConfig:
        return replace(self, **changes)

    def radius_table(self, stage: int, reach: int) -> tuple[float, ...]:
        """Radius per |dt| = 0..reach: r(d) = 0.5 + 0.1 d / (T-1), doubled in stage 2 (as the release)."""
        growth = 0.2 * self.radii[stage] / max(self.num_frames - 1, 1)
        return tuple(self.radii[stage] + growth * d for d in range(reach + 1))

    def groups(self, width: int) -> int:
        """Number of feature groups fitted at a layer of this width, the xyz group included."""
        if self.xyz_group:
            return int(width * self.reduction / self.group_size) + 1
        return max(1, round(width * self.reduction / self.group_size))

    def to_json(self) -> str:
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> KinetConfig:
        """Back from `to_json`; DataError on unknown keys, so that a newer file isn't silently misread."""
        values = json.loads(text)
        known = {field.name for field in fields(cls)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise DataError(f"the model's configuration has unknown keys {', '.join(unknown)}; a newer dpc wrote it")
        for key in ("centroids", "radii"):
            values[key] = tuple(values[key])
        if values.get("head"):
            values["head"] = tuple(values["head"])
        values["widths"] = tuple(tuple(pair) for pair in values["widths"])
        return cls(**values)


_LEAST = {
    "num_classes": (1, "number of classes"),
    "num_frames": (1, "--frames"),
    "points_per_frame": (1, "--points"),
    "neighbors": (1, "--neighbors"),
    "group_size": (1, "--group-size"),
    "temporal_radius": (0, "--temporal-radius"),
    "static_radius": (0, "--static-temporal-radius"),
}
_LEGAL = {
    "variant": VARIANTS,
    "normalize": ("none", "center", "height", "unit", "image"),
    "grouping": ("first", "nearest", "balanced"),
    "weighting": ("deviation", "projection", "none"),
    "merge": ("residual", "cross"),
    "solver": ("inverse", "ridge"),
    "guard": ("signed", "release"),
    "fusion": ("softmax", "logits"),
}
