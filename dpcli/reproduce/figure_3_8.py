"""Figure 3.8 and table A.1 of the thesis: parameters, operations and accuracy of three backbones, alone and in two streams.

    python -m dpcli.reproduce.figure_3_8 RAW FOLDER [--backbones pointnet2,dgcnn] [--flow icp] [-- words of `dpc classify train`]
    python -m dpcli.reproduce.figure_3_8 - FOLDER --profile-only

Each backbone: its static stream on 16 frames, the kinematic stream on it (Kinet), and the same static network on scene
flow, fused with it. Results: table.md and results.json in FOLDER after every network, figure.png at the end. Stopped, it goes on. A step
of the flow baseline that fails leaves a dash and its reason.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dpcli import __version__
from dpcli.draw.sheet import new_figure, save_figure
from dpcli.reproduce.accuracy_tables import EXPERIMENTS, Plan, Setting, add_plan, clips_of, clouds_of
from dpcli.reproduce.runs import (
    DASH,
    Cell,
    Dpc,
    attempt,
    beside,
    counted,
    cut,
    digest,
    dpc,
    markdown,
    numbers,
    once,
    samples,
    shares,
    write_json,
    write_text,
)

BACKBONES = {"pointnet2": "PointNet++", "dgcnn": "DGCNN", "spidercnn": "SpiderCNN"}
KINDS = {"static": "Static {}", "flow": "Flow-based two streams ({})", "kinet": "Kinet ({})"}
THESIS = {  # table A.1: FLOPs (G), parameters (M), accuracy (%)
    ("pointnet2", "static"): (4.82, 2.13, 84.30),
    ("pointnet2", "flow"): (163.93, 7.79, 90.23),
    ("pointnet2", "kinet"): (10.35, 3.20, 91.92),
    ("dgcnn", "static"): (5.33, 5.25, 84.18),
    ("dgcnn", "flow"): (164.95, 14.04, 89.56),
    ("dgcnn", "kinet"): (5.83, 5.85, 89.82),
    ("spidercnn", "static"): (13.40, 8.03, 83.49),
    ("spidercnn", "flow"): (181.09, 19.60, 89.23),
    ("spidercnn", "kinet"): (15.29, 8.62, 88.54),
}
PEERS = {"MeteorNet": (1.70, 17.60, 88.21), "PSTNet": (54.09, 8.44, 89.90), "P4Transformer": (40.38, 42.07, 89.56)}
_COLORS = {"pointnet2": "tab:blue", "dgcnn": "tab:green", "spidercnn": "tab:red"}
_MARKS = {"static": "o", "flow": "s", "kinet": "*"}
_BESIDE = {
    "MeteorNet": (14, -4),
    "PSTNet": (-12, 14),
    "P4Transformer": (-30, -34),
}  # where a peer's name stands, points
_NETWORK_POINTS = {"thesis": 2048}  # points a frame that the preset's networks take; the others at most 256


@dataclass(frozen=True)
class Cost:
    """Holds the cost of one row. paper: counted as table A.1 counts; true: 2 x multiply-adds / 1e9 and weights / 1e6."""

    paper_flops: float
    true_flops: float
    paper_parameters: float
    true_parameters: float


def costs(told: dict) -> dict[str, Cost]:
    """Returns the costs by kind, from what `dpc classify profile --json` says. Flow: twice the static network, without an estimator."""
    flops, macs = told["paper_style_gflops"], told["macs_per_clip"]
    paper, true = told["paper_style_parameters"], told["parameters"]
    one = Cost(flops["static"], 2 * macs["static"] / 1e9, paper["static"], true["static"] / 1e6)
    both = Cost(flops["total"], 2 * macs["total"] / 1e9, paper["total"], true["total"] / 1e6)
    twice = Cost(2 * one.paper_flops, 2 * one.true_flops, 2 * one.paper_parameters, 2 * one.true_parameters)
    return {"static": one, "flow": twice, "kinet": both}


def profile(run: Dpc, folder: Path, preset: str, backbone: str) -> dict[str, Cost]:
    """Returns the costs of a preset's networks on clips of 16 frames, 20 classes; measured once."""
    words = ["--preset", preset, "--backbone", backbone, "--frames", 16, "--classes", 20, "--json"]
    path = folder / f"profile-{preset}-{backbone}.json"
    return costs(once(path, [__version__, words], lambda: json.loads(run("classify", "profile", *words))))


@dataclass(frozen=True)
class Network:
    """Trains the networks of one backbone and seed in a folder of their own. flow: a method of `estimate-flow`, or a folder."""

    backbone: str
    seed: int
    plan: Plan
    clouds: Path
    folder: Path
    flow: str

    @property
    def place(self) -> Path:
        """Returns the folder of this backbone's networks."""
        return self.folder / self.backbone

    def cell(self, name: str, clouds: Path, *words: str) -> Cell:
        """Returns the cell of one network, trained on the clouds by more words."""
        setting = Setting(name, "", "", ("--set", f"backbone={self.backbone}", "--frames", "16", *words), "")
        cell = self.plan.cell(setting, self.seed, clouds, self.place)
        cell.scores = cell.folder / f"{name}.h5"
        return cell

    def static(self) -> Cell:
        """Returns the cell of the static network."""
        return self.cell("static", self.clouds, "--set", "epochs_dynamic=0")

    def kinet(self) -> Cell:
        """Returns the cell of Kinet, whose dynamic stream is trained on the static network."""
        return self.cell("kinet", self.clouds, "--epochs", "0", "--set", f"static_from={self.static().model}")

    @property
    def fused(self) -> Path:
        """Returns the scores file of both streams of the flow baseline."""
        return self.place / f"{self.plan.preset}-two-streams-seed{self.seed}.h5"

    def flow_file(self) -> Path:
        """Returns the file of the estimated flow as point clouds."""
        words = f"{self.plan.preset}-{Path(self.flow).name}"
        return self.folder / f"flow-{words}.h5"

    def two_streams(self, run: Dpc) -> dict | str:
        """Returns the accuracy of the flow baseline; the reason when one of its steps fails."""
        clouds, still = self.flow_file(), self.static()
        words = ("--flow", self.flow, "--as-points", "--points", _NETWORK_POINTS.get(self.plan.preset, 512))
        why = attempt(
            lambda: run("segment", "estimate-flow", self.clouds, "-o", clouds, *words), "`segment estimate-flow`"
        )
        if why:
            return why
        moving = self.cell("flow", clouds, "--set", "epochs_dynamic=0")
        why = attempt(lambda: moving.run(run), "training or predicting on flow")
        if why:
            return why
        why = attempt(
            lambda: run("classify", "fuse", still.scores, moving.scores, "-o", self.fused, "--force"), "`classify fuse`"
        )
        key = [digest(still.scores), digest(moving.scores)]
        return why or once(self.fused.with_suffix(".json"), key, lambda: counted(run, self.fused))


Found = Mapping[tuple[str, str], Sequence[dict]]


def table(known: Mapping[str, Mapping[str, dict[str, Cost]]], found: Found, about: Sequence[str]) -> str:
    """Returns markdown. known: by preset and backbone, the costs; found: by row, what its runs say."""
    header = ["model", "FLOPs (G), thesis / ours as it counts", "parameters (M), thesis / ours as it counts"]
    header += [f"FLOPs (G), parameters (M), true, preset {preset}" for preset in known]
    lines = []
    for (backbone, kind), (flops, parameters, accuracy) in THESIS.items():
        if backbone not in next(iter(known.values())):
            continue
        cost, own = known["thesis"][backbone][kind], found.get((backbone, kind), [])
        line = [
            KINDS[kind].format(BACKBONES[backbone]),
            f"{flops:.2f} / {cost.paper_flops:.2f}",
            f"{parameters:.2f} / {cost.paper_parameters:.2f}",
        ]
        line += [
            f"{one[backbone][kind].true_flops:.3g}, {one[backbone][kind].true_parameters:.3f}" for one in known.values()
        ]
        stream = "static" if kind == "static" else "fused"
        lines.append([*line, beside(accuracy, shares(own, stream)), len(own) or DASH, samples(own)])
    blank = [DASH] * len(known)
    for name, (flops, parameters, accuracy) in PEERS.items():
        lines.append(
            [name, f"{flops:.2f} / {DASH}", f"{parameters:.2f} / {DASH}", *blank, beside(accuracy, []), DASH, DASH]
        )
    header += ["accuracy, thesis / ours", "runs", "test videos"]
    return (
        "\n\n".join(["# Figure 3.8 and table A.1: 16 frames of MSRAction-3D", markdown(header, lines), *about]) + "\n"
    )


def _area(parameters: float) -> float:
    """Returns the area of a mark, never too small to be seen."""
    return max(30 * parameters, 25)


def picture(cost: Mapping[str, dict[str, Cost]], found: Found, path: Path) -> None:
    """Draws accuracy over operations, an area for the parameters: the thesis's hollow, ours filled where they are known."""

    figure = new_figure(8.5, 5.5)
    axes = figure.add_subplot()
    for (backbone, kind), (flops, parameters, accuracy) in THESIS.items():
        style = {"marker": _MARKS[kind], "edgecolors": _COLORS[backbone]}
        name = KINDS[kind].format(BACKBONES[backbone])
        axes.scatter(flops, accuracy, s=_area(parameters), facecolors="none", **style)
        own = shares(found.get((backbone, kind), []), "static" if kind == "static" else "fused")
        if own:
            at = cost[backbone][kind]
            axes.scatter(
                at.paper_flops, sum(own) / len(own), s=_area(at.paper_parameters), color=_COLORS[backbone], **style
            )
        axes.scatter([], [], marker=_MARKS[kind], color=_COLORS[backbone], label=name)
    for name, (flops, parameters, accuracy) in PEERS.items():
        axes.scatter(flops, accuracy, s=_area(parameters), facecolors="none", edgecolors="0.5", marker="D")
        axes.annotate(name, (flops, accuracy), textcoords="offset points", xytext=_BESIDE[name], color="0.4")
    axes.set(
        xscale="log",
        xlabel="FLOPs of a clip (G), as the thesis counts",
        ylabel="accuracy (%)",
        title="Hollow: the thesis. Filled: ours. Area: parameters",
    )
    axes.grid(color="0.92")
    figure.legend(loc="outside right upper", frameon=False, fontsize=8)
    save_figure(figure, path, 120)


def _about(plan: Plan, flow: str, reasons: Mapping[str, str]) -> list[str]:
    notes = [
        f"Accuracies of ours: preset {plan.preset}, `dpc classify train --preset {plan.preset} --validation none "
        f"{' '.join(plan.budget)}`; the first FLOPs and parameters are those of the preset `thesis`, which the table is of.",
        "As the thesis counts: 2 x multiply-adds of the layers as written / 2^30; weights, Adam's moments and moving "
        "statistics / 2^20, of Kinet's frozen static stream the weights alone. True: 2 x multiply-adds as computed / 1e9; "
        "trainable weights / 1e6. Peers are counted in plain millions.",
        f"Flow-based: flow by `{flow}` (the thesis: JustGo, 3.54 M and 154.29 G, which its rows hold and ours don't).",
    ]
    return notes + [f"{KINDS['flow'].format(BACKBONES[name])}: {DASH}, {why}." for name, why in reasons.items()]


def make(
    clouds: Path | None,
    folder: Path,
    plan: Plan,
    seeds: Sequence[int],
    backbones: Sequence[str],
    flow: str = "icp",
    run: Dpc = dpc,
) -> dict[tuple[str, str], list[dict]]:
    """Runs what isn't done; writes a table after each network, the picture at the end. clouds: None profiles only."""
    known = {
        preset: {name: profile(run, folder, preset, name) for name in backbones}
        for preset in dict.fromkeys(("thesis", plan.preset))
    }
    found: dict[tuple[str, str], list[dict]] = {}
    reasons: dict[str, str] = {}

    def tell() -> None:
        """Writes what is known so far."""
        about = _about(plan, flow, reasons)
        write_json(
            folder / "results.json",
            {"table": "A.1", "about": about, "runs": {f"{name} {kind}": own for (name, kind), own in found.items()}},
        )
        write_text(folder / "table.md", table(known, found, about))

    tell()
    try:
        for seed in seeds if clouds else ():
            for name in backbones:
                network = Network(name, seed, plan, clouds, folder, flow)
                for kind, cell in (("static", network.static()), ("kinet", network.kinet())):
                    found.setdefault((name, kind), []).append(cell.run(run))
                    tell()
                told = network.two_streams(run)
                if isinstance(told, str):
                    reasons[name] = told
                else:
                    found.setdefault((name, "flow"), []).append(told)
                tell()
    finally:  # of what is there when stopped, too
        picture(known[plan.preset], found, folder / "figure.png")
    return found


def main(argv: Sequence[str] | None = None, run: Dpc = dpc) -> None:
    """Runs the program by its words; `run` does the commands."""
    own, budget = cut(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backbones", default=",".join(BACKBONES))
    parser.add_argument(
        "--flow", default="icp", help="a method of `dpc segment estimate-flow`, or a folder of `segment flow`"
    )
    parser.add_argument("--profile-only", action="store_true", help="parameters and operations, no training")
    add_plan(parser, "folder of MSRAction-3D; - with --clouds or --profile-only")
    given = parser.parse_args(own)
    backbones = given.backbones.split(",")
    if set(backbones) - set(BACKBONES):
        parser.error(f"--backbones {given.backbones}: expected some of {', '.join(BACKBONES)}")
    clouds = given.clouds if given.profile_only else clouds_of(given, EXPERIMENTS["3.4"], run)
    plan = Plan(given.preset, clips_of(given.preset, given.clips), tuple(budget))
    make(clouds, given.folder, plan, numbers(given.seeds), backbones, given.flow, run)
    sys.stdout.write((given.folder / "table.md").read_text())


if __name__ == "__main__":
    main()
