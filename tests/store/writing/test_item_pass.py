"""The pass of many items into one file: what is passed over, and what a stop leaves."""

from __future__ import annotations

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
