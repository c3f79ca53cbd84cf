"""The pass of many items into one file: what is passed over, and what a stop leaves."""

from __future__ import annotations

from functools import partial

import pytest

from dpcli.errors import Stopped
from dpcli.runtime.machines.spread import Workers
from dpcli.runtime.pool import LostWorker
from dpcli.store.statistics import StatisticsReader, StatisticsWriter
from dpcli.store.writing.item_pass import ItemPass, Wording

NAMES = ["a", "b", "c", "d"]


def test_an_item_lost_before_a_stop_is_passed_over_after_it(tmp_path):
    """It can't be put in any more, and must not cost the others."""

    def lost_at_one(place: int) -> int:
        if place == 1:
            raise LostWorker("died")
        return place

    def one_pass(work, stop_at: int) -> list[tuple[str, str]]:
        options = {"class_names": ["a"], "provenance": [{"config": {}}], "resume": True}
        with StatisticsWriter(tmp_path / "a.h5", **options) as writer:

            def write(place: int, value: int) -> dict:
                if place == stop_at:
                    raise Stopped("now")
                writer.write(NAMES[place], {"value": value})
                return {}

            taken = ItemPass(writer, NAMES, Wording("test", "item", "counted"))
            taken.run(work, lambda place: place, write, Workers())
            return writer.skipped

    with pytest.raises(Stopped):
        one_pass(lost_at_one, 3)
    ((name, reason),) = one_pass(lambda place: place, -1)
    assert name == "b" and "--force starts over" in reason
    assert StatisticsReader(tmp_path / "a.h5").names == ["a", "c", "d"]


@pytest.mark.parametrize(
    ("resume", "said"), [(True, "1 of 4 items are kept; run again to continue"), (False, "nothing was kept")]
)
def test_an_interrupt_says_what_is_kept_which_in_a_pipe_is_nothing(resume, said, tmp_path, capsys):
    def work(place: int) -> int:
        if place == 1:
            raise KeyboardInterrupt
        return place

    with (
        pytest.raises(KeyboardInterrupt),
        StatisticsWriter(tmp_path / "a.h5", class_names=["a"], provenance=[{"config": {}}], resume=resume) as writer,
    ):
        write = partial(_write, writer)
        ItemPass(writer, NAMES, Wording("test", "item", "counted")).run(work, lambda place: place, write, Workers())
    bar, last = capsys.readouterr().err.splitlines()  # the bar ends first: what is kept stands above the error
    assert bar.startswith("dpc: test 1/4 25%") and last == f"dpc: warning: interrupted; {said}"
    assert sorted(path.name for path in tmp_path.iterdir()) == ([".a.h5.new", ".a.h5.part"] if resume else [])


def _write(writer: StatisticsWriter, place: int, value: int) -> dict:
    writer.write(NAMES[place], {"value": value})
    return {}
