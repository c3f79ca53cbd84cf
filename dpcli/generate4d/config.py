"""What a fit is told: sizes, steps, rates, weights and switches. `thesis` follows appendix C, `quick` two CPU cores."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

from dpcli.errors import UsageError

PRIORS = ("none", "views", "zero123")
STARTS = ("auto", "sphere", "inflate", "hull")


@dataclass(frozen=True)
class FitConfig:
    """Lengths in the scene's unit (the object fits a sphere of 0.75), rates are Adam's.

    Weights of losses are those of thesis 5.4.3 and C.2 where it gives them, else SC4D's (reconstruction 5000, alpha a tenth
    of it, control points 10, as-rigid-as-possible 10).
    """

    size: int = 256  # pixels: the side that targets are resized to
    dense_steps: int = 1000
    sparse_steps: int = 500
    batch: int = 4  # pictures per step
    start: str = "auto"  # inflate for one view, hull for several
    start_radius: float = 0.5  # of --start sphere
    gaussians: int = 4096  # at the start
    most_gaussians: int = 80_000
    parts: int = 8
    control_points: int = 512
    neighbors: int = 8  # control points that move a Gaussian
    width: int = 256
    depth: int = 8
    partition: str = "static"  # or "time": a part may gain and lose points while the clip plays (M^tau of the thesis)
    seeds: bool = True  # parts start from places spread over the object instead of a random network
    # switches of Table 5.2
    rigid: bool = True
    temporal: bool = True
    spatial: bool = True
    fusion: bool = True
    sparse: bool = True
    # weights
    reconstruction: float = 5000.0
    foreground: float = 0.1  # of the reconstruction's
    views: float = 1.0  # of the reconstruction's, for given novel views
    augmentation: float = 1.0  # score distillation
    identification: float = 1.0
    temporal_weight: float = 10.0
    spatial_weight: float = 0.1
    spatial_radius: float = 0.1
    spatial_neighbors: int = 10
    control: float = 10.0
    arap: float = 10.0
    thickness: float = 100.0  # --prior none: depth stays where the silhouette's inflation put it
    roundness: float = 10.0  # longest axis of a Gaussian at most `aspect` times its mean
    aspect: float = 2.0
    # rates: (first, last), log-linear in between
    rate_mean: tuple[float, float] = (1e-2, 2e-4)
    rate_opacity: float = 0.05
    rate_scale: float = 0.005
    rate_quaternion: float = 0.005
    rate_color: float = 0.01
    rate_radius: float = 0.005
    rate_network: tuple[float, float] = (2e-4, 2e-6)
    rate_rigid: float = 0.01
    rate_control: float = 2e-6
    # densify and prune
    grow_every: int = 100
    grow_until: float = 0.8  # of all steps
    grow_share: float = 0.1  # at most this share of the Gaussians at a time
    grow_threshold: float = 0.0  # of the mean screen gradient per step, in units of half a picture
    prune_opacity: float = 0.01
    # pictures
    coarse: tuple[tuple[float, int], ...] = ((0.13, 4), (0.2, 2))  # until this share of the steps: 1/n of the size
    inversion: float = 0.5  # probability of a black background

    def __post_init__(self) -> None:
        for name, low in (
            ("size", 16),
            ("dense_steps", 1),
            ("sparse_steps", 0),
            ("batch", 1),
            ("parts", 1),
            ("control_points", 1),
            ("neighbors", 1),
            ("gaussians", 16),
        ):
            if getattr(self, name) < low:
                raise UsageError(f"--{name.replace('_', '-')} {getattr(self, name)}: expected {low} or more")
        if self.most_gaussians < self.gaussians:
            raise UsageError(
                f"--most-gaussians {self.most_gaussians}: expected at least the {self.gaussians} of the start (--gaussians)"
            )
        if self.start not in STARTS:
            raise UsageError(f"--start {self.start}: expected one of {', '.join(STARTS)}")
        if self.partition not in ("static", "time"):
            raise UsageError(f"--partition {self.partition}: expected static or time")

    @property
    def steps(self) -> int:
        return self.dense_steps + self.sparse_steps

    @property
    def sparse_from(self) -> int:
        """First step of the sparse stage; past the end when it is switched off."""
        return self.dense_steps if self.sparse else self.steps


PRESETS = {
    "thesis": FitConfig(size=512, start="sphere", seeds=False),
    "quick": FitConfig(
        dense_steps=600,
        sparse_steps=2000,
        batch=2,
        gaussians=6000,
        most_gaussians=12_000,
        width=96,
        depth=4,
        rate_mean=(2e-3, 2e-4),
        rate_network=(2e-3, 2e-4),
        rate_rigid=2e-3,
        rate_scale=0.01,
        grow_share=0.15,
    ),
    "tiny": FitConfig(
        size=48,
        dense_steps=20,
        sparse_steps=20,
        batch=1,
        gaussians=300,
        most_gaussians=400,
        width=16,
        depth=2,
        parts=3,
        control_points=24,
        rate_mean=(2e-3, 2e-4),
        rate_network=(2e-3, 2e-4),
        rate_rigid=2e-3,
        grow_every=10,
        coarse=(),
    ),
}


def preset(name: str, **changes: object) -> FitConfig:
    """A named preset with some fields changed; None leaves a field alone."""
    if name not in PRESETS:
        raise UsageError(f"--preset {name}: expected one of {', '.join(PRESETS)}")
    known = {field.name for field in fields(FitConfig)}
    unknown = sorted(changes.keys() - known)
    if unknown:
        raise UsageError(f"unknown setting {unknown[0]!r} of a fit; expected one of {', '.join(sorted(known))}")
    given = {key: value for key, value in changes.items() if value is not None}
    if (
        "most_gaussians" in given and "gaussians" not in given
    ):  # the preset's start may be more than what is allowed now
        given["gaussians"] = min(PRESETS[name].gaussians, int(given["most_gaussians"]))
    return replace(PRESETS[name], **given)
