"""The folder a training run writes: checkpoints, logs, curves. Nothing here knows how a step is computed."""

from __future__ import annotations

import csv
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import torch

from dpcli.config_diff import differences
from dpcli.errors import DataError, DpcError, UsageError
from dpcli.file_lock import open_alone
from dpcli.runtime.progress import log
from dpcli.runtime.torch_files import load_plain
from dpcli.runtime.whole_file import DiskFull, disk_full, make_folder, whole_file
from dpcli.text_files import read_json

_FIRST_PICTURE = 10.0  # seconds of a run before curves are drawn: drawing takes half a second, more than a small epoch
_TOLD = 3  # differences named when a run can't be continued
_LOCK = ".lock"
_PATIENCE = 5  # steps without a finite loss or gradient before a run counts as lost
# What --force removes; the flows are those of `segment train`, the preview that of `generate4d fit`.
_FILES = (
    "state.pt",
    "last.safetensors",
    "best.safetensors",
    "log.csv",
    "log.json",
    "curves.png",
    "flows_first.npy",
    "flows.npy",
    "flows_known.npy",
    "preview.png",
)


@dataclass
class LossWatch:
    """Says when a training has diverged: no finite loss or gradient for five steps on end, or a loss that is on average above
    `limit`. beside: what is said of that limit.
    """

    limit: float = math.inf
    beside: str = ""
    lost: int = 0
    mean: float = math.nan

    def see(self, loss: float, stepped: bool) -> str | None:
        """Takes the loss after each step; returns a sentence once it is time to stop. stepped: the gradient was finite."""
        self.lost = 0 if stepped and math.isfinite(loss) else self.lost + 1
        if self.lost >= _PATIENCE:
            return f"no finite loss or gradient in {_PATIENCE} steps on end"
        if math.isfinite(loss):
            self.mean = loss if math.isnan(self.mean) else 0.95 * self.mean + 0.05 * loss
        return f"the loss grew to {self.mean:.3g}{self.beside}" if self.mean > self.limit else None


def diverged(problem: str, where: str, remedy: str) -> DpcError:
    """Returns the error of a training that ran away. remedy: what may help in another folder."""
    return DpcError(
        f"training diverged ({where}): {problem}.\nStart another -o{remedy}, or look at the data (dpc info FILE)"
    )


def state_of(trainer: object, names: Sequence[str]) -> dict[str, Any]:
    """Returns what a saved state holds of the named attributes of a trainer: of networks and optimizers, their own state."""
    found = {name: getattr(trainer, name) for name in names}
    return {name: value.state_dict() if hasattr(value, "state_dict") else value for name, value in found.items()}


def take_state(trainer: object, names: Sequence[str], state: dict[str, Any]) -> None:
    """Gives a trainer the named attributes that `state_of` returned."""
    for name in names:
        own = getattr(trainer, name)
        own.load_state_dict(state[name]) if hasattr(own, "load_state_dict") else setattr(trainer, name, state[name])


class RunFolder:
    """Keeps what a training run writes into its folder, and guards the folder against other runs.

    It holds `config.json`, `settings.toml`, `state.pt` (to continue), `last.safetensors`, `best.safetensors`, `log.csv`, `log.json`,
    `curves.png`.

    config: what must be equal for a run to continue, compared as JSON holds it. columns: what a row of the log holds.
    curves: draws the rows into a picture file. Only looks until it is entered (`with`): that makes the folder, with
    `force` empties it of an earlier run, and keeps other processes from writing into it by a lock on the file `.lock`,
    which is gone at the end; a killed run may leave that file, which then locks nothing.

    Raises UsageError when the folder holds a run of another configuration, or files of a run without one, and `force`
    is off; DpcError on entering when another process is there.
    """

    def __init__(
        self,
        path: str | Path,
        config: dict,
        force: bool = False,
        *,
        columns: Sequence[str],
        curves: Callable[[list[dict], Path], None] | None = None,
    ) -> None:
        self.columns, self.curves = tuple(columns), curves
        self.path, self.config, self.force = Path(path), json.loads(json.dumps(config)), force
        self.rows: list[dict] = []
        # rows that the picture shows; when it may be drawn next
        self._drawn, self._draw_again = 0, time.monotonic() + _FIRST_PICTURE
        self._lock = -1
        if self.path.exists() and not self.path.is_dir():
            raise UsageError(f"{self.path}: is a file; -o of train names a folder")
        self._continues()

    def __enter__(self) -> RunFolder:
        make_folder(self.path)
        try:
            self._lock = open_alone(self.path / _LOCK)
        except DpcError:
            raise DpcError(
                f"{self.path}: cannot write (another dpc is writing it); wait until it is done, or use another -o"
            ) from None
        try:
            if not self._continues():  # again: another run may have been here since
                for name in _FILES:
                    (self.path / name).unlink(missing_ok=True)
                _replace(self.path / "config.json", json.dumps(self.config, indent=1, sort_keys=True))
        except BaseException:
            self._release()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if not isinstance(error, (OSError, DiskFull)):
                self._draw_rest()
        except (OSError, DiskFull) as problem:
            self._tell_full(problem)
            raise
        finally:
            self._release()
        self._tell_full(error)

    def _tell_full(self, error: BaseException | None) -> None:
        """Raises DiskFull, with what becomes of the run, where that is what an error means."""
        full = disk_full(Path(error.filename or self.path), error) if isinstance(error, OSError) else error
        if isinstance(full, DiskFull):
            saved = ": it continues from the last saved state" if (self.path / "state.pt").exists() else ""
            raise DiskFull(f"{full}{saved}") from None

    def _release(self) -> None:
        (self.path / _LOCK).unlink(missing_ok=True)
        os.close(self._lock)

    def _continues(self) -> bool:
        """Returns whether an earlier run of this configuration is there, to go on with. Raises UsageError for anything else."""
        saved = self.path / "config.json"
        if self.force:
            return False
        if not saved.exists():
            left = [name for name in _FILES if (self.path / name).exists()]
            if left:
                raise UsageError(
                    f"{self.path}: holds {', '.join(left)}, but no config.json that says which run they belong to;"
                    " use another -o, or --force to replace them"
                )
            return False
        try:
            before = read_json(saved)
        except DataError:
            raise DataError(f"{saved}: not JSON, the run can't be continued; --force starts over") from None
        differing = differences(before, self.config)
        if differing:
            more = f", and {len(differing) - _TOLD} more" if len(differing) > _TOLD else ""
            raise UsageError(
                f"{self.path}: holds a run with another configuration ({'; '.join(differing[:_TOLD])}{more});"
                " use another -o, or --force to start over"
            )
        return True

    def refuse_inside(self, option: str, file: Path) -> None:
        """Raises UsageError when `file`, named by an option to start from, is among those that the run replaces."""
        if self.path.resolve() in (file.parent.resolve(), file.resolve().parent):
            raise UsageError(f"{option} {file}: is in the folder of -o, whose files this run replaces; use another -o")

    def file(self, name: str) -> Path:
        """Returns the path of a file of the run."""
        return self.path / name

    def load_state(self) -> dict | None:
        """Reads what an earlier run saved; None for a fresh one. Raises UsageError where it is gone, which would start over.

        A state follows each row of a log that weights lie beside, so a kill leaves one such row without a state at most.
        """
        path = self.path / "state.pt"
        if not path.exists():
            if (self.path / "last.safetensors").exists() and len(self._logged()) > 1:
                raise UsageError(
                    f"{path}: is gone, and without it the run of this folder would start over and replace its weights; bring it"
                    " back, use another -o, or --force to start over"
                )
            return None
        with self.restoring():
            state = load_plain(path)
            self.rows = state["rows"]
        return state

    def _logged(self) -> list:
        """Returns the rows of the log that is there; none where it can't be read."""
        try:
            return list(read_json(self.path / "log.json"))
        except (OSError, DataError):
            return []

    @contextmanager
    def restoring(self) -> Iterator[None]:
        """Raises DataError where the block stumbles over the saved state, which is damaged then, or another run's."""
        try:
            yield
        except (DataError, LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            said = " ".join(str(error).split())[:200]
            raise DataError(
                f"{self.path / 'state.pt'}: the saved state is damaged ({said or type(error).__name__}); --force starts over"
            ) from None

    def resume(self, restore: Callable[[dict], None]) -> dict | None:
        """Gives what an earlier run saved to `restore` and returns it; None for a fresh run. Raises as `load_state` and `restoring`."""
        state = self.load_state()
        if state is not None:
            with self.restoring():
                restore(state)
        return state

    def tell_continuing(self, where: str | None) -> None:
        """Says where an earlier run goes on; None: at its end."""
        log.info(
            f"continuing {self.path} at {where}" if where else f"{self.path}: is finished already; --force starts over"
        )

    def save_state(self, state: dict) -> None:
        """Writes what `load_state` reads again, whole or not at all."""
        with whole_file(self.path / "state.pt") as part, open(part, "wb") as file:  # given a name, torch says no reason
            torch.save({**state, "rows": self.rows}, file)

    def log(self, row: dict) -> None:
        """Appends one row and rewrites the small log files whole, so that a reader never sees half a line."""
        self.rows.append({key: row.get(key) for key in self.columns})
        _replace(self.path / "log.json", json.dumps(self.rows, indent=1))
        with whole_file(self.path / "log.csv") as part, open(part, "w", newline="") as file:
            writer = csv.DictWriter(file, self.columns)
            writer.writeheader()
            writer.writerows(self.rows)

    def write_settings(self, text: str) -> None:
        """Writes the resolved settings as `settings.toml`, which `--config` reads back."""
        _replace(self.path / "settings.toml", text)

    def draw_curves(self) -> None:
        """Draws the learning curves so far, by the function given, for at most a twentieth of the time; the end draws the rest."""
        if time.monotonic() >= self._draw_again:
            self._draw_rest()

    def _draw_rest(self) -> None:
        if self.curves is not None and len(self.rows) > self._drawn:
            started = time.monotonic()
            self.curves(self.rows, self.path / "curves.png")
            self._drawn, now = len(self.rows), time.monotonic()
            self._draw_again = now + 20 * (now - started)


def _replace(path: Path, text: str) -> None:
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
