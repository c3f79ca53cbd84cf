"""The settings of a fit: sizes, steps, weights of losses, learning rates, and the presets `thesis`, `quick`, `fast` and `tiny`.

`thesis` follows appendix C of the thesis, `quick` suits two CPU cores, `fast` is a look within two minutes on them, `tiny`
a trial of some seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Catalog, Given
from dpcli.runtime.settings.fields import WIDEST, Settings, setting

Start = Literal["auto", "sphere", "inflate", "hull"]
Prior = Literal["auto", "none", "inflated", "network", "views", "zero123"]


@dataclass(frozen=True)
class FitConfig(Settings):
    """Holds how a scene is fitted. Lengths are in the scene's unit (the object fits a sphere of 0.75), rates are Adam's.

    Weights of losses are those of the thesis (5.4.3 and C.2) where it gives them, else those of SC4D (Wu et al. 2024):
    reconstruction 5000, silhouette a tenth of it, drift of control points 10, as-rigid-as-possible 10.
    Raises UsageError for a value that is not legal.
    """

    size: int = setting(256, "Longer side of the fitted pictures, pixels.", least=16, most=8192)
    dense_steps: int = setting(1000, "Steps of the dense stage, in which every Gaussian moves by itself.", least=1)
    sparse_steps: int = setting(500, "Steps of the sparse stage, in which control points carry the Gaussians.", least=0)
    batch: int = setting(4, "Pictures per step.", least=1)
    start: Start = setting(
        "auto",
        "Where the first Gaussians are: in a sphere, in the inflated silhouette of one view, in the hull of several; "
        "auto inflates one or two views and takes the hull of more.",
    )
    start_radius: float = setting(0.5, "Radius of the sphere of start = sphere, scene units.", above=0)
    gaussians: int = setting(4096, "Gaussians at the start.", least=16)
    max_gaussians: int = setting(
        80_000, "Gaussians at most; a number below `gaussians` also lowers those at the start.", least=16
    )
    parts: int = setting(8, "Rigid parts at most; the fit itself blends the motions of 8 at most.", least=1, most=1000)
    control_points: int = setting(512, "Control points at most.", least=1)
    neighbors: int = setting(8, "Control points that move one Gaussian.", least=1)
    width: int = setting(256, "Width of the motion networks' layers.", least=1, most=WIDEST)
    depth: int = setting(
        8, "Layers of the deformation network; the other networks have half as many.", least=1, most=100
    )
    partition: Literal["static", "time"] = setting(
        "static", "static: a point keeps its part; time: a part may gain and lose points while the clip plays."
    )
    seeds: bool = setting(
        True, "Start the parts at places spread over the object, not where an untrained network puts them."
    )

    rigid: bool = setting(True, "Use rigid motion of parts; false leaves only non-rigid motion (row a of Table 5.2).")
    temporal: bool = setting(True, "Find parts by temporal-change preservation, eq. 5.3; false: row b of Table 5.2.")
    spatial: bool = setting(True, "Keep neighboring points in one part by spatial coherence, eq. 5.4.")
    fusion: bool = setting(
        True,
        "Blend rigid and non-rigid motion by a learned weight, eq. 5.6; false adds them, eq. 5.5 (rows b, c of Table 5.2).",
    )
    sparse: bool = setting(True, "Have a sparse stage; false stays dense to the end (rows a to d of Table 5.2).")

    reconstruction: float = setting(5000.0, "Weight of the pictures' loss.", least=0)
    foreground: float = setting(0.1, "Weight of the silhouette, as a share of the reconstruction's.", least=0)
    shape: tuple[float, float] = setting(
        (1.0, 0.3),
        "Weight of a shape prior's pictures from the sides, first and last, log-linear, as a share of the reconstruction's.",
        above=0,
    )
    shape_until: float = setting(
        0.8,
        "Share of the steps in which those pictures count; the last steps use only the given views.",
        least=0,
        most=1,
    )
    shape_size: int = setting(96, "Side of a shape prior's pictures, pixels.", least=16, most=1024)
    views: float = setting(1.0, "Weight of given novel views, as a share of the reconstruction's.", least=0)
    augmentation: float = setting(1.0, "Weight of score distillation, eq. C.11.", least=0)
    identification: float = setting(1.0, "Weight of both losses that find parts.", least=0)
    temporal_weight: float = setting(10.0, "Weight lambda_temporal of eq. 5.3.", least=0)
    spatial_weight: float = setting(0.1, "Weight lambda_spatial of eq. 5.4.", least=0)
    spatial_radius: float = setting(0.1, "Distance within which points are neighbors in eq. 5.4, scene units.", above=0)
    spatial_neighbors: int = setting(10, "Neighbors of a point in eq. 5.4, at most.", least=1)
    control: float = setting(
        10.0, "Weight of the drift of control points from the dense stage's motion, C.13.", least=0
    )
    arap: float = setting(10.0, "Weight of the as-rigid-as-possible energy.", least=0)
    thickness: float = setting(
        1000.0,
        "Weight that keeps one view's depth where the start put it, or, where a shape prior tells it, alike in all frames.",
        least=0,
    )
    aspect: float = setting(2.0, "Longest axis of a Gaussian over its mean axis, at most.", least=1)

    rate_mean: tuple[float, float] = setting((1e-2, 2e-4), "Rate of positions, first and last, log-linear.", above=0)
    rate_opacity: float = setting(0.05, "Rate of opacities.", least=0)
    rate_scale: float = setting(0.005, "Rate of sizes.", least=0)
    rate_quaternion: float = setting(0.005, "Rate of orientations.", least=0)
    rate_color: float = setting(0.01, "Rate of colors.", least=0)
    rate_radius: float = setting(0.005, "Rate of the control points' radii.", least=0)
    rate_network: tuple[float, float] = setting(
        (2e-4, 2e-6), "Rate of all networks except that of the parts' motion, first and last, log-linear.", above=0
    )
    rate_rigid: float = setting(0.01, "Rate of the network of the parts' motion.", least=0)
    rate_control: float = setting(2e-6, "Rate of the control points' positions.", least=0)

    grow_every: int = setting(100, "Steps between two rounds of densifying and pruning.", least=1)
    grow_until: float = setting(0.8, "Share of all steps after which Gaussians are only pruned.", least=0, most=1)
    grow_share: float = setting(0.1, "Share of the Gaussians that one round adds, at most.", least=0, most=1)
    grow_threshold: float = setting(
        0.0, "Mean screen gradient above which a Gaussian is densified, in units of half a picture.", least=0
    )
    prune_opacity: float = setting(0.01, "Opacity below which a Gaussian is dropped.", least=0, most=1)

    coarse: tuple[tuple[float, int], ...] = setting(
        ((0.13, 4), (0.2, 2)), "Until this share of the steps, pictures are 1/n of the size: share,n.", above=0
    )
    inversion: float = setting(0.5, "Probability that a picture's background is black, not white.", least=0, most=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_gaussians < self.gaussians:
            raise UsageError(
                f"max_gaussians = {self.max_gaussians}: expected at least the {self.gaussians} of the start (gaussians)"
            )

    @property
    def blended_parts(self) -> int:
        """Returns how many parts' motions the fit blends: with 16 instead of the thesis's 8 the network tears bodies apart."""
        return min(self.parts, 8)

    @property
    def steps(self) -> int:
        """Returns the steps of both stages together."""
        return self.dense_steps + self.sparse_steps

    @property
    def sparse_from(self) -> int:
        """Returns the first step of the sparse stage; past the end when it is switched off."""
        return self.dense_steps if self.sparse else self.steps


@dataclass(frozen=True)
class Supervision(Settings):
    """Holds what guides the sides of the object that nobody filmed. Raises UsageError for a value that is not legal."""

    prior: Prior = setting(
        "auto",
        "What is known beside the input view: nothing, the inflated silhouette, the shape network, the file's views of "
        "the role train, or a diffusion model; auto takes the network for what looks like a creature, else the inflated silhouette.",
    )
    prior_model: str | None = setting(
        None,
        "Model of --prior zero123: a local folder, or a hub's id, which is then downloaded; or of --prior network: "
        "other weights, a file or a folder of train-prior.",
    )
    regularize: bool = setting(
        True, "Keep the object from becoming flat by the loss `thickness` and the limit `aspect`."
    )


CATALOG = Catalog(fit=FitConfig, supervision=Supervision)
_QUICK = FitConfig(
    dense_steps=600,
    sparse_steps=2000,
    batch=2,
    gaussians=6000,
    max_gaussians=12_000,
    parts=16,
    width=96,
    depth=4,
    rate_mean=(2e-3, 2e-4),
    rate_network=(2e-3, 2e-4),
    rate_rigid=2e-3,
    rate_scale=0.01,
    grow_share=0.15,
)
FIT_PRESETS = {
    "thesis": FitConfig(size=512, start="sphere", seeds=False),
    "quick": _QUICK,
    "fast": replace(
        _QUICK,
        dense_steps=40,
        sparse_steps=460,
        gaussians=5000,
        max_gaussians=8000,
        rate_mean=(2e-3, 5e-4),
        rate_network=(3e-3, 3e-4),
        rate_rigid=3e-3,
    ),
    "tiny": FitConfig(
        size=48,
        dense_steps=20,
        sparse_steps=20,
        batch=1,
        gaussians=300,
        max_gaussians=400,
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
PRESETS: dict[str, dict[str, Any]] = {
    name: {"fit": config, "supervision": Supervision()} for name, config in FIT_PRESETS.items()
}


def resolve_settings(given: Given) -> tuple[FitConfig, Supervision]:
    """Returns the preset's settings with what a user gave over them. Raises UsageError where they don't fit one another.

    A limit below the number of Gaussians that the preset starts with lowers that number, unless it was given too.
    """
    base, values = dict(PRESETS[given.preset or "quick"]), given.values
    if "max_gaussians" in values and "gaussians" not in values:
        base["fit"] = replace(base["fit"], gaussians=min(base["fit"].gaussians, values["max_gaussians"]))
    resolved = CATALOG.resolve(base, given)
    return resolved["fit"], resolved["supervision"]


def unread_settings(given: Given, config: FitConfig, supervision: Supervision) -> list[str]:
    """Returns a sentence for each switch beside which nothing reads some of the settings that a user gave and changed."""
    prior = supervision.prior
    unread = (
        (f"start = {config.start}", config.start != "sphere", ("start_radius",)),
        ("rigid or temporal = false", not (config.rigid and config.temporal), ("temporal_weight",)),
        ("rigid or spatial = false", not (config.rigid and config.spatial), ("spatial_weight",)),
        (
            "sparse = false",
            not config.sparse,
            ("control_points", "neighbors", "control", "rate_control", "rate_radius"),
        ),
        ("regularize = false", not supervision.regularize, ("thickness", "aspect")),
        (f"prior = {prior}", prior in ("none", "views", "zero123"), ("shape", "shape_until", "shape_size")),
        (f"prior = {prior}", prior != "views", ("views",)),
        (f"prior = {prior}", prior != "zero123", ("augmentation",)),
    )
    preset = PRESETS[given.preset or "quick"]["fit"]
    changed = {name for name in given.values if getattr(config, name, None) != getattr(preset, name, None)}
    found = ((why, [name for name in names if name in changed]) for why, holds, names in unread if holds)
    return [f"{', '.join(names)}: not read with {why}" for why, names in found if names]
