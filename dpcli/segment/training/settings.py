"""The settings of `dpc segment train`, and their two presets; nothing here needs torch, since `--help` reads it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Catalog
from dpcli.runtime.settings.fields import Settings, setting, settings_of
from dpcli.segment.network.config import NETWORK_PRESETS, NetworkSettings, Precision


@dataclass(frozen=True)
class RunSettings(Settings):
    """Holds what a training starts from, and what it keeps apart to judge itself."""

    flow: str = setting(
        "icp",
        "First flow of every pair: icp (rigid bodies), nearest (point), or the file or folder of a trained estimator"
        " (dpc segment flow).",
    )
    flows_of: str | None = setting(None, "Folder of a run on the same pairs, whose first flows are taken over.")
    init: str | None = setting(None, "Trained part network to start from: a file, a training folder or a shipped name.")
    validation: str = setting(
        "auto",
        "Sequences held out from training: auto (split 'validation', where there is one), none, a fraction of the"
        " training sequences, or class names with commas.",
    )


@dataclass(frozen=True)
class Schedule(Settings):
    """Holds how long and how fast a network learns. A pair gives two frames to each step."""

    epochs: int = setting(10, "Epochs; each passes over pairs_per_epoch pairs.", least=1)
    pairs_per_epoch: int = setting(1000, "Pairs drawn for each epoch; 0 takes all.", least=0)
    batch: int = setting(8, "Pairs per step.", least=1)
    learning_rate: float = setting(
        1e-3, "Adam's learning rate; it falls to zero along a cosine after a short warm-up.", above=0, name="lr"
    )
    weight_decay: float = setting(1e-4, "Weight decay of Adam.", least=0)
    augment: bool = setting(True, "Turn every pair at random.")
    validation_pairs: int = setting(48, "Most pairs of the held-out sequences that are looked at.", least=1)

    def learning_rate_at(self, step: int, steps: int) -> float:
        """Returns the learning rate of one step (from 0) of `steps`."""
        warm = max(1, min(100, steps // 10))
        if step < warm:
            return self.learning_rate * (step + 1) / warm
        return self.learning_rate * 0.5 * (1 + math.cos(math.pi * (step - warm) / max(steps - warm, 1)))


@dataclass(frozen=True)
class Objective(Settings):
    """Holds the weights and switches of the loss (thesis 4.4.4). Times are fractions of the whole training."""

    form: Literal["blended", "per-part"] = setting(
        "blended", "Rigidity loss: blended, as released, or per-part, eq. 4.8 as written.", name="loss"
    )
    dynamic: float = setting(10.0, "Weight of the rigidity of the flow within each part.", least=0)
    smooth: float = setting(0.1, "Weight of the smoothness of masks.", least=0)
    invariance: float = setting(0.0, "Weight of the agreement between two turned copies.", least=0)
    motion: float = setting(0.1, "Weight of the motion head's loss.", least=0)
    cold_start: float = setting(
        1.0, "Weight, in the first part of the training, of the bodies that the flow alone shows.", least=0
    )
    cold_until: float = setting(1.0, "Fraction of the training after which cold_start counts no more.", least=0)
    supervised: bool = setting(False, "Learn from part ids and poses (or scene flow) instead of the estimated flow.")
    consensus: Literal["thesis", "release", "none"] = setting(
        "thesis", "Weights from the motion head: thesis (eq. 4.7), release (squared, gated) or none."
    )
    tau: float = setting(20.0, "Sharpness of the consensus weights, per object diameter.", above=0)
    flow_decay: float = setting(
        0.9, "alpha of eq. 4.6: 1 keeps the first flow (past), 0 takes the newest (current).", least=0, most=1
    )
    motion_after: float = setting(
        0.3, "Fraction of the training before the motion head learns; above 1: never.", least=0
    )
    consensus_after: float = setting(0.5, "Fraction of the training before consensus weighs; above 1: never.", least=0)
    update_after: float = setting(0.4, "Fraction of the training before flows are corrected; above 1: never.", least=0)
    smooth_after: float = setting(0.03, "Fraction of the training before smoothness counts; above 1: never.", least=0)


class TrainSettings(NamedTuple):
    """Holds all settings of `dpc segment train`, by group."""

    network: NetworkSettings = NetworkSettings()
    run: RunSettings = RunSettings()
    precision: Precision = Precision()
    schedule: Schedule = Schedule()
    objective: Objective = Objective()

    def refuse_unread(self) -> None:
        """Raises UsageError for settings that were changed, but that nothing reads beside the others that were chosen."""
        objective, motion_head = self.objective, self.network.motion_head
        unread = (
            ("supervised = true", objective.supervised, _WITHOUT_LABELS),
            ("motion_head = false", not motion_head, ("motion", "motion_after")),
            ("no consensus", not motion_head or objective.consensus == "none", ("tau", "consensus_after")),
            ("cold_start = 0", not objective.cold_start, ("cold_until",)),
            ("flow_decay = 1", objective.flow_decay == 1, ("update_after",)),
        )
        changed = {
            one.name
            for group in (self.run, objective)
            for one in settings_of(type(group))
            if getattr(group, one.field) != one.default
        }
        for why, holds, names in unread:
            if wrong := [name for name in names if holds and name in changed]:
                raise UsageError(f"{', '.join(wrong)}: not read with {why}; leave out one or the other")


_WITHOUT_LABELS = (
    *("flow", "flows_of", "loss", "dynamic", "smooth", "smooth_after", "invariance", "cold_start", "cold_until"),
    *("consensus", "consensus_after", "tau", "flow_decay", "update_after", "motion_after"),
)
CATALOG = Catalog(network=NetworkSettings, run=RunSettings, precision=Precision, schedule=Schedule, objective=Objective)
PRESETS = {name: TrainSettings(network)._asdict() for name, network in NETWORK_PRESETS.items()}
