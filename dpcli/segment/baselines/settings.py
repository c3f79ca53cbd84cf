"""The choice of a method and the settings of the classical ones; nothing here needs torch, since `--help` reads it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

from dpcli.errors import UsageError
from dpcli.runtime.settings.fields import Settings, setting

_SHARED = ("motion", "max_parts", "smallest_cluster", "max_points")
METHODS = {  # and what each reads beside the shared settings
    "dbscan": ("eps", "min_points", "motion_weight"),
    "ward": ("threshold", "motion_weight"),
    "ssc": ("alpha", "fewest", "still"),
    "trajaffn": ("sigma", "reach", "fewest", "still"),
}
_MOTION = {"dbscan": "none", "ward": "none", "ssc": "flow", "trajaffn": "residual"}
_FEWEST = {"ssc": 2, "trajaffn": 1}


@dataclass(frozen=True)
class ClassicalSettings(Settings):
    """Holds the method and the settings of the classical ones. Lengths are in diameters of the object.

    dbscan: Ester et al., KDD 1996. ward: Ward, JASA 1963. ssc: sparse subspace clustering, Elhamifar and Vidal, TPAMI
    2013. trajaffn: trajectory affinities, Ochs, Malik and Brox, TPAMI 2014; the published affinity compares the flow
    itself, the residual, ours, finds more where the whole object turns.
    """

    method: Literal["multibody", "scene", "network", "dbscan", "ward", "ssc", "trajaffn"] = setting(
        "multibody",
        "What finds the parts: multibody (one set of rigid bodies explains all frames together), scene (streets: what moves"
        " on its own in lidar scans or depth images; --scene chooses it too), network (a trained part network, frame by"
        " frame; --model or --fast choose it too), or a classical method.",
    )
    parts: int | None = setting(
        None, "Number of parts into which a classical --method divides each frame; none: found from the data.", least=1
    )
    motion: Literal["auto", "none", "flow", "residual"] = setting(
        "auto",
        "What is used besides the coordinates: nothing, the flow, or the residual, which is the flow minus the dominant"
        " rigid motion of the frame; auto: none for dbscan and ward, flow for ssc, residual for trajaffn.",
    )
    max_parts: int = setting(8, "Most parts where a classical --method finds their number.", least=1)
    smallest_cluster: float = setting(
        0.02,
        "Parts of a smaller share of a frame's points join their neighbor (--method); with --parts N at most 1 / 2N.",
        least=0,
    )
    max_points: int = setting(1024, "Frames of more points are divided on a sample of this size (--method).", least=2)
    eps: float = setting(0.1, "dbscan: distance within which points are neighbors, in diameters.", above=0)
    min_points: int = setting(5, "dbscan: neighbors that make a point a core point.", least=1)
    motion_weight: float = setting(1.0, "dbscan, ward: weight of motion relative to space.", least=0)
    threshold: float = setting(
        0.2, "ward: merges stop at this distance over the root of the number of points, in diameters.", above=0
    )
    alpha: float = setting(800.0, "ssc: weight of the fit.", above=0)
    fewest: int | None = setting(
        None, "ssc, trajaffn: least number of parts where it is found; none: 2 for ssc, 1 for trajaffn.", least=1
    )
    still: float = setting(
        0.005,
        "ssc, trajaffn: a frame whose points follow one rigid motion up to this root mean square, in diameters, is one"
        " part.",
        least=0,
    )
    sigma: float = setting(0.1, "trajaffn: difference of motion that counts as one, in diameters.", above=0)
    reach: float = setting(0.1, "trajaffn: distance that counts as one, in diameters.", above=0)

    def __post_init__(self) -> None:
        """Raises UsageError for a wrong value, or a setting that belongs to another method."""
        super().__post_init__()
        if self.method in ("ssc", "trajaffn") and self.motion == "none":
            raise UsageError(f"motion = none: --method {self.method} sees only motion; expected flow or residual")
        legal = ("method", "parts", *_SHARED, *METHODS[self.method]) if self.classical else ("method",)
        for field in dataclasses.fields(self):
            if getattr(self, field.name) != field.default and field.name not in legal:
                raise UsageError(self._refuse(field.name))

    @property
    def classical(self) -> bool:
        """Is true for a classical method."""
        return self.method in METHODS

    def _refuse(self, name: str) -> str:
        """Returns why a setting that was changed can't be meant."""
        owners = [method for method, own in METHODS.items() if name in own] or list(METHODS)
        if not self.classical:
            return f"{name} belongs to --method {' or '.join(owners)}; {self.method} finds its own number of parts"
        return f"{name} belongs to --method {' or '.join(owners)}; {self.method} has {', '.join(METHODS[self.method])}"

    def least_share(self, smallest: float) -> float:
        """Returns the share of the points below which parts are given up: `smallest`, but where the number of parts is given,
        at most half of what each would have if all were equally large. Else 40 parts asked for could not all be found.

        >>> ClassicalSettings(method="ward", parts=40).least_share(0.03)
        0.0125
        """
        return smallest if self.parts is None else min(smallest, 0.5 / self.parts)

    def used(self) -> dict[str, Any]:
        """Returns the settings that the method reads, by name, with those that are left to it resolved."""
        own = {name: getattr(self, name) for name in ("method", "parts", *_SHARED, *METHODS[self.method])}
        own["smallest_cluster"] = self.least_share(self.smallest_cluster)
        if self.motion == "auto":
            own["motion"] = _MOTION[self.method]
        if own.get("fewest", 0) is None:
            own["fewest"] = _FEWEST[self.method]
        return own

    def resolved(self) -> ClassicalSettings:
        """Returns the settings with those that are left to the method resolved."""
        return dataclasses.replace(self, **self.used())
