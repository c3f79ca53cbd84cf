"""The settings of multi-body motion segmentation; nothing here needs torch, since `--help` reads it."""

from __future__ import annotations

from dataclasses import dataclass

from dpcli.runtime.settings.fields import Settings, setting


@dataclass(frozen=True)
class MultibodySettings(Settings):
    """Holds the weights of the energy that all bodies of a sequence share, and how far the search for them goes.

    Costs are in units of one point whose residuals are all at their worst.
    """

    max_bodies: int = setting(24, "multibody: bodies of a sequence at most.", least=1)
    body_price: float = setting(
        0.001,
        "multibody: cost of a further body, as a share of all points; between two frames, at least 9 points.",
        least=0,
    )
    border: float = setting(0.3, "multibody: cost of a point whose neighbors are all in other bodies.", least=0)
    agreement: float = setting(
        0.3, "multibody: cost of a point whose nearest points in other frames are all in other bodies.", least=0
    )
    hinge: float = setting(
        0.7,
        "multibody: share of both costs that is waived where a point's body and the other one move it to the same place.",
        least=0,
        most=1,
    )
    displacement: float = setting(
        0.05,
        "multibody: cost of a point per diameter of its distance from where the largest body would move it.",
        least=0,
    )
    flexible: float = setting(
        0.02, "multibody: how far points deviate from rigid motion where tracks are given, diameters.", above=0
    )
    regrow: int = setting(
        2,
        "multibody: rounds in which each body in turn is removed and its points are explained again; then as many in which "
        "bodies are split.",
        least=0,
    )
