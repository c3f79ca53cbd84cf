"""The run of a fit: its folder, log, checkpoints and previews. A run that is stopped or killed continues."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from dpcli.errors import DpcError
from dpcli.generate4d.optimizer import SceneOptimizer, StepResult
from dpcli.generate4d.scene.model import Model4D
from dpcli.runtime.progress import Progress
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.signals import StopRequest

COLUMNS = ("step", "stage", "loss", "psnr", "gaussians", "seconds")
_SAVE_EVERY, _LOG_EVERY, _PREVIEWS = 200, 20, 5
_AVERAGED = 8  # steps that the log's averages go on with after each row


class FitRun:
    """Runs a `SceneOptimizer` to its last step. `preview(model)` is called at the start and after each fifth of the steps."""

    def __init__(
        self,
        optimizer: SceneOptimizer,
        folder: RunFolder,
        stop: StopRequest,
        preview: Callable[[Model4D], None] | None = None,
    ) -> None:
        self.optimizer, self.folder, self.stop, self.preview = optimizer, folder, stop, preview
        self.steps = optimizer.config.steps
        self.seconds, self._counted = 0.0, time.monotonic()
        self.recent: dict[str, list[float]] = {}
        self._gaussians = 0

    def run(self) -> Model4D:
        """Goes from the folder's saved state, or the start, to the last step; returns the model, on the fit's device.

        Raises DpcError when the loss is no longer finite, Stopped after a signal, once the state is saved.
        """
        if self.folder.resume(self._restore) is None:
            self._start()
        self._counted = time.monotonic()
        with Progress("fit", self.steps, "step") as bar:
            bar.skip(self.optimizer.step)
            while self.optimizer.step < self.steps:
                with self._told_where_it_diverges():
                    result = self.optimizer.take_step()
                    if self._is_kept(self.optimizer.step):
                        self.optimizer.require_finite()
                self._record(result)
                bar.note(**self._averages())
                bar.advance()
                step = self.optimizer.step
                if step % _SAVE_EVERY == 0 or self.stop.requested or step == self.steps:
                    self._count_seconds()
                    self.folder.save_state({**self.optimizer.state(), "spent": self.seconds, "recent": self.recent})
                self.stop.check(f"saved at step {step}")
        self.folder.draw_curves()
        return self.optimizer.model

    def _start(self) -> None:
        self.optimizer.start()
        if self.preview is not None:
            self.preview(self.optimizer.model)

    def _restore(self, state: dict) -> None:
        self.seconds, self.recent = state["spent"], state["recent"]
        self.optimizer.restore(state)

    def _is_kept(self, step: int) -> bool:
        """Returns whether the model after this step is drawn or saved."""
        return step % _SAVE_EVERY == 0 or step == self.steps or step % self._between_previews == 0

    @property
    def _between_previews(self) -> int:
        return max(self.steps // _PREVIEWS, 1)

    @contextmanager
    def _told_where_it_diverges(self) -> Iterator[None]:
        try:
            yield
        except FloatingPointError as error:
            raise DpcError(
                f"{self.folder.path}: step {self.optimizer.step}: {error}; the last checkpoint is kept; try smaller rates or another --seed"
            ) from None

    def _record(self, result: StepResult) -> None:
        self.recent.setdefault("loss", []).append(result.loss)
        if math.isfinite(result.squared_error):
            self.recent.setdefault("squared", []).append(result.squared_error)
        self._gaussians, step = result.gaussians, self.optimizer.step
        if step % _LOG_EVERY == 0 or step == self.steps:
            self._count_seconds()
            stage = "sparse" if self.optimizer.model.control is not None else "dense"
            self.folder.log({"step": step, "stage": stage, "seconds": round(self.seconds, 1), **self._averages()})
            self.recent = {key: values[-_AVERAGED:] for key, values in self.recent.items()}
        if self.preview is not None and step % self._between_previews == 0:
            self.preview(self.optimizer.model)

    def _count_seconds(self) -> None:
        now = time.monotonic()
        self.seconds, self._counted = self.seconds + now - self._counted, now

    def _averages(self) -> dict:
        """Returns the mean loss and PSNR of the latest steps, and the number of Gaussians."""
        mean = {key: float(np.mean(values)) for key, values in self.recent.items()}
        psnr = -10 * math.log10(max(mean.get("squared", 1.0), 1e-10))
        return {"loss": round(mean.get("loss", math.nan), 3), "psnr": round(psnr, 2), "gaussians": self._gaussians}
