"""Figures drawn with matplotlib: learning curves, confusion matrix, bars. What they show is read from the figure itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib import font_manager, rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from dpcli.classify.explain import pictures
from dpcli.draw import bars, confusion_matrix, learning_curves
from dpcli.draw.bars import Bars, Histogram, draw_panels
from dpcli.draw.confusion_matrix import draw_confusion
from dpcli.draw.learning_curves import Curve, Panel, draw_learning_curves
from dpcli.draw.reliability import Reliability
from dpcli.draw.sheet import save_figure
from dpcli.errors import DataError
from dpcli.evaluate.bootstrap import Interval, Resampling
from dpcli.evaluate.compare import paired_picture
from dpcli.evaluate.compare.file_metrics import EvaluationOptions
from dpcli.evaluate.compare.paired import Change, CompareReport, Paired
from dpcli.evaluate.compare.significance_tests import McNemar
from dpcli.evaluate.segmentation import class_bars


@pytest.fixture
def saved(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that were written, still open."""
    figures: list[Figure] = []

    def keep(figure: Figure, path: Path, dpi: int = 150) -> None:
        figures.append(figure)
        save_figure(figure, path, dpi)

    for module in (bars, confusion_matrix, learning_curves, paired_picture, pictures):
        monkeypatch.setattr(module, "save_figure", keep)
    return figures


def test_curves_leave_out_what_is_not_known(saved: list[Figure], tmp_path: Path) -> None:
    rows = [{"epoch": n, "loss": 2.0 / n, "accuracy": None if n == 2 else n / 10, "truth": None} for n in (1, 2, 3)]
    panel = Panel(
        "training",
        [Curve("loss", "loss"), Curve("truth", "never there")],
        range=(0, None),
        right=[Curve("accuracy", "accuracy", 100)],
        right_range=(0, 102),
        change=2.5,
    )
    late = Panel("late", [Curve("loss", "loss")], rows=rows[1:], logarithmic=True)
    draw_learning_curves(rows, [panel, late], tmp_path / "curves.png", "epoch")
    left, second, right = saved[0].axes
    assert left.get_lines()[0].get_xydata().tolist() == [[1, 2], [2, 1], [3, 2 / 3]]
    assert right.get_lines()[0].get_xydata().tolist() == [[1, 10], [3, 30]] and right.get_ylim() == (0, 102)
    assert [text.get_text() for text in left.get_legend().get_texts()] == ["loss", "accuracy"]
    assert second.get_yscale() == "log" and len(second.get_lines()[0].get_xdata()) == 2 and second.get_legend() is None
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_a_log_without_numbers_is_drawn(saved: list[Figure], tmp_path: Path) -> None:
    draw_learning_curves([{"step": 1, "x": None}], [Panel("empty", [Curve("x", "x")])], tmp_path / "a.png", "step")
    assert not saved[0].axes[0].get_lines()


def test_a_person_s_matplotlibrc_changes_no_picture(tmp_path: Path) -> None:
    """Where there is no TeX, its first line ended the command."""
    rows, panel = [{"step": n, "x": n} for n in (1, 2)], Panel("one", [Curve("x", "x")])
    draw_learning_curves(rows, [panel], tmp_path / "plain.png", "step")
    with rc_context({"text.usetex": True, "font.size": 30, "axes.facecolor": "black", "savefig.bbox": "tight"}):
        draw_learning_curves(rows, [panel], tmp_path / "own.png", "step")
    assert (tmp_path / "own.png").read_bytes() == (tmp_path / "plain.png").read_bytes()


def test_one_epoch_has_one_whole_tick(saved: list[Figure], tmp_path: Path) -> None:
    draw_learning_curves([{"epoch": 1, "x": 0.5}], [Panel("one", [Curve("x", "x")])], tmp_path / "a.png", "epoch")
    low, high = saved[0].axes[0].get_xlim()
    assert [tick for tick in saved[0].axes[0].get_xticks() if low <= tick <= high] == [1]


def test_a_confusion_matrix_shows_counts_and_shares(saved: list[Figure], tmp_path: Path) -> None:
    counts = np.array([[3, 1, 0], [0, 2, 0], [0, 0, 0]])
    draw_confusion(
        counts, ["wave", "push", "a name that is far too long for an axis"], "accuracy 83 %", tmp_path / "c.png"
    )
    axes = saved[0].axes[0]
    shares = np.asarray(axes.get_images()[0].get_array())
    np.testing.assert_allclose(shares, [[0.75, 0.25, 0], [0, 1, 0], [0, 0, 0]])
    told = {(round(t.get_position()[1]), round(t.get_position()[0])): t.get_text() for t in axes.texts}
    assert told == {(0, 0): "3", (0, 1): "1", (1, 1): "2"}
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names[0] == "wave 0" and len(names[2]) <= 30 and "…" in names[2]
    assert axes.get_title() == "accuracy 83 %"


def test_bars_leave_undefined_numbers_out(saved: list[Figure], tmp_path: Path) -> None:
    panels = [
        Bars(["all", "cup"], {"AP": [50.0, np.nan], "PQ": [120.0, 10.0]}, "%", 100),
        Bars(["all"], {"AccS": [120.0]}, "% of points", 100, cut=True),
        Histogram(np.array([5.0, 5.0, 95.0, np.nan]), "%", "sequences"),
    ]
    draw_panels(panels, 2, "Parts", tmp_path / "b.png")
    first, cut, counted = saved[0].axes
    assert [bar.get_width() for bar in first.patches] == [50, 0, 120, 10] and first.get_xlim()[1] > 120
    assert cut.get_xlim() == (0, 100)
    assert sum(bar.get_height() for bar in counted.patches) == 3 and len(counted.patches) == 20
    assert first.get_ylim() == (1.6, -0.6) and all(tick == int(tick) for tick in counted.get_yticks())
    with pytest.raises(DataError, match="cannot be written"):
        draw_panels(panels, 2, "Parts", tmp_path / "no" / "b.png")


def _texts_cut_off(figure: Figure) -> list[str]:
    """The texts that reach over the edge of a figure that was saved."""
    figure.set_layout_engine("none")
    figure.set_dpi(150)
    renderer, (width, height) = FigureCanvasAgg(figure).get_renderer(), figure.bbox.size
    shown = [text for text in figure.findobj(Text) if text.get_visible() and text.get_text().strip()]
    boxes = [text.get_window_extent(renderer) for text in shown]
    inside = [box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height for box in boxes]
    return [text.get_text() for text, fits in zip(shown, inside, strict=True) if not fits]


@pytest.mark.parametrize("name", ["x", "draw circle", "n" * 90])
@pytest.mark.parametrize("classes", [1, 11])
def test_no_text_is_cut_off(saved: list[Figure], tmp_path: Path, name: str, classes: int) -> None:
    bins = np.linspace(0.02, 0.98, 15)
    headline = "fused 93.1 % (230/247), static 88.1 %, dynamic 90.1 %\nsplit test"
    for beside in (None, Reliability(np.ones(15, int), bins, bins, "calibration error 10.0 % (by chance 3.0 %)")):
        draw_confusion(np.eye(classes, dtype=int), [name] * classes, headline, tmp_path / "c.png", beside)
    titles = [class_bars._counted(f"{label} {name}", 120) for label in range(classes)]
    panels = [
        Bars(titles, {key: [50.0] * classes for key in ("AP", "PQ", "F1", "mIoU", "Rand index")}, "%", 100),
        Bars(titles, {f"AccS {tau}": [50.0] * classes for tau in range(4)}, "% of points", 100, cut=True),
    ]
    draw_panels(panels, classes, "Parts, protocol dpc, split all", tmp_path / "b.png")
    assert [_texts_cut_off(figure) for figure in saved] == [[], [], []]


def test_a_comparison_of_files_in_deep_folders_shows_their_names(saved: list[Figure], tmp_path: Path) -> None:
    change = Change("fraction", 0.5, 0.75, Interval(-0.5, 0.1), 0.3, 1, 2, 1, 0.7)
    hits = (np.array([1.0, 0, 1, 0]), np.array([0.0, 1, 1, 1]))
    part = Paired(
        "classification",
        "samples",
        list("abcd"),
        {"top5_accuracy": change},
        "top5_accuracy",
        [],
        McNemar(0, 3, 0.25),
        hits,
        [],
    )
    deep = "a_long_name_of_a_folder/" * 9
    report = CompareReport((f"{deep}one.h5", f"{deep}two.h5"), EvaluationOptions(), Resampling(0), [part], ([], []))
    paired_picture.draw_comparison(report, tmp_path / "d.png")
    (figure,) = saved
    assert _texts_cut_off(figure) == []
    first, second = figure.get_suptitle().splitlines()
    assert first.startswith("A: …") and first.endswith("/one.h5") and second.endswith("/two.h5")
    counts = figure.axes[
        -1
    ]  # McNemar's test is of the best class; these are the samples of the metric that was asked for
    assert [text.get_text() for text in counts.texts] == ["1", "1", "2", "0"] and "top-5" in counts.get_title()


def test_every_class_of_a_plane_is_in_its_legend_under_its_own_name(saved: list[Figure], tmp_path: Path) -> None:
    names = ["_idle", r"$\frac{a$", "a_b $x^2$", "two\nlines", "", "n" * 90]
    labels = np.arange(-1, 7)  # unknown, six with a name or none, one beyond the names
    places = {stream: np.random.default_rng(0).normal(size=(8, 2)) for stream in ("static", "dynamic")}
    pictures.plane_picture(tmp_path / "p.png", places, labels, names, dict.fromkeys(places, "silhouette 0.31"))
    told = [text.get_text() for text in saved[0].legends[0].get_texts()]
    assert told[:4] == ["no label", *names[:3]] and len(told) == 8 and "\n" not in told[4]
    assert told[5] == "4" and told[6].endswith("…") and told[7] == "6" and _texts_cut_off(saved[0]) == []


def test_letters_that_no_font_has_are_told(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(font_manager, "findSystemFonts", list)
    for names, words in ((["\u624b\u3092\u632f\u308b", "\u624b"], "has 4 letters"), (["Grün", "волна"], "")):
        draw_confusion(np.eye(2, dtype=int), names, "accuracy 100 %", tmp_path / "c.png")
        told = capsys.readouterr().err
        assert words in told and bool(words) == bool(told)
