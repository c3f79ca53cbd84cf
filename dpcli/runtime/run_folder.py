"""The folder a training run writes: checkpoints, logs, curves. Nothing here knows how a step is computed."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from dpcli.errors import DataError, UsageError

_TOLD = 3  # differences named when a run can't be continued


class RunFolder:
    """`config.json`, `state.pt` (to continue), `last.safetensors`, `best.safetensors`, `log.csv`, `log.json`, `curves.png`.

    columns: what a row of the log holds. curves: draws the rows into a picture file. Raises UsageError when the folder
    holds a run of another configuration and `force` is off.
    """

    def __init__(
        self, path: str | Path, config: dict, force: bool = False, *, columns: Sequence[str],
        curves: Callable[[list[dict], Path], None] | None = None,
    ) -> None:  # fmt: skip
        self.columns, self.curves = tuple(columns), curves
        self.path = Path(path)
        if self.path.exists() and not self.path.is_dir():
            raise UsageError(f"{self.path}: is a file; -o of train names a folder")
        self.path.mkdir(parents=True, exist_ok=True)
        saved = self.path / "config.json"
        if saved.exists() and not force:
            try:
                before = json.loads(saved.read_text())
            except ValueError:
                raise DataError(f"{saved}: not JSON, the run can't be continued; --force starts over") from None
            differing = _differences(before, config)
            if differing:
                more = f", and {len(differing) - _TOLD} more" if len(differing) > _TOLD else ""
                raise UsageError(
                    f"{self.path}: holds a run with another configuration ({'; '.join(differing[:_TOLD])}{more});"
                    " use another -o, or --force to start over"
                )
        else:
            for name in ("state.pt", "last.safetensors", "best.safetensors", "log.csv", "log.json", "curves.png"):
                (self.path / name).unlink(missing_ok=True)
            _replace(saved, json.dumps(config, indent=1, sort_keys=True))
        self.rows: list[dict] = []

    def file(self, name: str) -> Path:
        return self.path / name

    def load_state(self) -> dict | None:
        """What an earlier, unfinished run saved; None for a fresh one."""
        path = self.path / "state.pt"
        if not path.exists():
            return None
        try:
            state = torch.load(path, weights_only=True, map_location="cpu")
        except Exception as error:
            raise DataError(
                f"{path}: the saved state is damaged ({type(error).__name__}); --force starts over"
            ) from None
        self.rows = state["rows"]
        return state

    def save_state(self, state: dict) -> None:
        part = self.path / ".state.pt.part"
        torch.save({**state, "rows": self.rows}, part)
        os.replace(part, self.path / "state.pt")

    def log(self, row: dict) -> None:
        """Append one epoch and rewrite the small log files whole, so that a reader never sees half a line."""
        self.rows.append({key: row.get(key) for key in self.columns})
        _replace(self.path / "log.json", json.dumps(self.rows, indent=1))
        part = self.path / ".log.csv.part"
        with open(part, "w", newline="") as file:
            writer = csv.DictWriter(file, self.columns)
            writer.writeheader()
            writer.writerows(self.rows)
        os.replace(part, self.path / "log.csv")

    def draw_curves(self) -> None:
        """The learning curves so far, by the function given."""
        if self.rows and self.curves is not None:
            self.curves(self.rows, self.path / "curves.png")


def _differences(before: object, now: object) -> list[str]:
    """One phrase for each setting that isn't the same, nested ones by their path."""
    old, new = _settings(before), _settings(now)
    pairs = {name: (old.get(name, "absent"), new.get(name, "absent")) for name in sorted(old.keys() | new.keys())}
    return [f"{name} {was}, now {is_now}" for name, (was, is_now) in pairs.items() if was != is_now]


def _settings(value: object, path: str = "") -> dict[str, str]:
    """A nested record as one level, values as JSON: {"network.num_frames": "16"}."""
    if not isinstance(value, dict):
        return {path: json.dumps(value, sort_keys=True)}
    return {name: one for key, item in value.items() for name, one in _settings(item, f"{path}.{key}" if path else key).items()}


def _replace(path: Path, text: str) -> None:
    part = path.with_name(f".{path.name}.part")
    part.write_text(text)
    os.replace(part, path)
