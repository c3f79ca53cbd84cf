"""The settings of multi-body motion segmentation; nothing here needs torch, since `--help` reads it."""

from __future__ import annotations

from dataclasses import dataclass

from dpcli.runtime.settings.fields import check, setting


@dataclass(frozen=True)
class MultibodySettings:
    """Holds the weights of the energy that all bodies of a sequence share, and how far the search for them goes.

    Costs are in units of one point whose residuals are all at their worst.
    """

    most_bodies: int = setting(24, "multibody: most bodies of a sequence.", least=1)
    body_price: float = setting(0.001, "multibody: cost of a further body, as a share of all points.", least=0)
    border: float = setting(0.3, "multibody: cost of a point whose neighbors are all in other bodies.", least=0)
    agreement: float = setting(
        0.3, "multibody: cost of a point whose nearest points in other frames are all in other bodies.", least=0
    )
    hinge: float = setting(
        0.7,
        "multibody: share of both that a point is spared where its body and the other one take it to one place.",
        least=0,
        most=1,
    )
    displacement: float = setting(
        0.05, "multibody: cost of a point per diameter that it lies from where the largest body would take it.", least=0
    )
    flexible: float = setting(
        0.02, "multibody: how far points bend away from rigid motion where tracks are given, diameters.", above=0
    )
    regrow: int = setting(
        2,
        "multibody: rounds in which each body in turn is taken out and its points are explained anew; then as many "
        "with bodies split.",
        least=0,
    )

    def __post_init__(self) -> None:
        check(self)
