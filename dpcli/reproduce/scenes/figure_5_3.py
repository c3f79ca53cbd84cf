"""Figure 5.3 of the thesis on animated meshes: the number of control points, and the weight of temporal preservation.

    python -m dpcli.reproduce.scenes.figure_5_3 MESHES OUT [--clips Cow:Gallop,...] [--sweep control_points=32,512] [words]

Clips, views, steps and words are those of `table_5_2`. Each setting is swept with the other at the thesis's choice. Results:
OUT/table.md and OUT/figure.png. What is done already is not done again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from dpcli.draw.sheet import new_figure, save_figure
from dpcli.reproduce.runs import markdown, sweeps, write_text
from dpcli.reproduce.scenes.table_5_2 import fit_all, mean_score, parser_of

SWEEPS = {  # setting -> title, values, the thesis's choice
    "control_points": ("control points K at most", (32, 128, 512, 1024), 512),
    "temporal_weight": ("weight of temporal preservation", (1, 10, 100), 10),
}
_SCORES = {  # title -> where evaluate video has it
    "PSNR novel views": ("per_role", "test", "psnr"),
    "SSIM novel views": ("per_role", "test", "ssim"),
    "parts, ARI": ("parts", "adjusted_rand_index"),
    "parts found": ("counts", "parts", "discovered"),
}
Found = Mapping[tuple[str, float], Sequence[dict]]  # (setting, value) -> scores of the clips


def table(found: Found) -> str:
    """Returns markdown: a line for each value, means over clips."""
    lines = [
        (
            SWEEPS[setting][0],
            f"{value:g}",
            *(f"{mean_score(list(scores), *keys):.3f}" for keys in _SCORES.values()),
            "yes" if value == SWEEPS[setting][2] else "",
        )
        for (setting, value), scores in found.items()
    ]
    clips = len(next(iter(found.values())))
    said = f"Means over {clips} clips; views that no fit sees. The thesis draws its numbers and prints none."
    return "\n\n".join([said, markdown(("setting", "value", *_SCORES, "thesis's choice"), lines)]) + "\n"


def picture(found: Found, path: Path) -> None:
    """Draws a panel for each setting and score: every clip thin, the mean thick, the thesis's choice dashed."""

    settings = list(dict.fromkeys(setting for setting, _ in found))
    figure = new_figure(3.2 * len(_SCORES), 3 * len(settings))
    panels = figure.subplots(len(settings), len(_SCORES), squeeze=False)
    for row, setting in zip(panels, settings):
        values = [value for other, value in found if other == setting]
        for axes, (title, keys) in zip(row, _SCORES.items()):
            clips = zip(*([mean_score([one], *keys) for one in found[setting, value]] for value in values))
            for clip in clips:
                axes.plot(values, clip, color="0.75", linewidth=1)
            means = [mean_score(list(found[setting, value]), *keys) for value in values]
            axes.plot(values, means, color="tab:orange", linewidth=2.5, marker="o")
            axes.axvline(SWEEPS[setting][2], color="0.4", linestyle="--", linewidth=1)
            axes.set(xscale="log", xlabel=SWEEPS[setting][0], title=title)
            axes.set_xticks(values, [f"{value:g}" for value in values])
            axes.minorticks_off()
    save_figure(figure, path, 120)


def swept(options: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Returns the values of each sweep; `control_points=32,512` gives the values of one, and others are then left out."""
    values = {setting: tuple(sorted(set(own))) for setting, own in sweeps(options, SWEEPS, least=1).items()}
    return values or {setting: own for setting, (_, own, _) in SWEEPS.items()}


def main() -> None:
    """Fits and scores all values; writes the table and the figure."""
    parser = parser_of(__doc__)
    parser.add_argument("--sweep", action="append", default=[])
    given = parser.parse_args()
    points = [(setting, value) for setting, values in swept(given.sweep).items() for value in values]
    fits = {f"{setting}={value:g}": (f"-{setting}-{value:g}", [f"{setting}={value:g}"]) for setting, value in points}
    found = dict(zip(points, fit_all(given, fits).values()))
    text = table(found)
    write_text(given.out / "table.md", text)
    picture(found, given.out / "figure.png")
    print(text, end="")


if __name__ == "__main__":
    main()
