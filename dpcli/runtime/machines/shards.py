"""One list of items in pieces: `--shard i/n` takes every n-th one, and any cut gives the same results."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from dpcli.errors import UsageError


@dataclass(frozen=True)
class Shard:
    """Names piece `index` (from 0) of `count`: the items at places index, index + count, ... of the whole list.

    `count` is a logical number, whatever machines there are, so that a failed piece can be made again alone.
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Reads `i/n`, 0 <= i < n. Raises UsageError for anything else."""
        match = re.fullmatch(r"(\d+)/(\d+)", text.strip(), re.ASCII)
        if not match or int(match[1]) >= int(match[2]):
            raise UsageError(f"--shard {text}: expected i/n with i from 0 to n - 1, such as 0/16 ... 15/16")
        return cls(int(match[1]), int(match[2]))

    def places(self, total: int) -> range:
        """Returns which of `total` items are its own.

        >>> list(Shard.parse("1/3").places(8))
        [1, 4, 7]
        """
        return range(self.index, total, self.count)

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"


WHOLE = Shard(0, 1)


def describe_shard(entry: dict[str, Any], shard: Shard | None) -> dict[str, Any]:
    """Returns a provenance entry of a shard: the whole's, and under `config` which piece of it this is."""
    return entry if shard is None else {**entry, "config": {**entry["config"], "shard": str(shard)}}


def shard_of(entry: dict[str, Any]) -> tuple[Shard, dict[str, Any]] | None:
    """Returns the piece an entry tells of, and the entry of the whole; None when it tells of no piece."""
    config = dict(entry.get("config", {}))
    text = config.pop("shard", None)
    return (Shard.parse(text), {**entry, "config": config}) if isinstance(text, str) else None
