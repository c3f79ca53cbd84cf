"""Something heavy, such as a network, that every process makes for itself once, however many items it works on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

Made = TypeVar("Made")
_made: dict[str, Any] = {}  # of this process: the latest only, by what it was made of


class OncePerProcess(Generic[Made]):
    """Holds what `make()` returns. Pickled, it holds the recipe alone, and the process that unpickles it makes its own.

    mark: what tells one result from another, such as the digest of a weights file; `make` must be picklable.
    """

    def __init__(self, make: Callable[[], Made], mark: str, made: Made | None = None) -> None:
        self._make, self._mark, self._own = make, mark, made

    def get(self) -> Made:
        """Returns what `make()` returned in this process, which is called at the first time."""
        if self._own is not None:
            return self._own
        if self._mark not in _made:
            _made.clear()
            _made[self._mark] = self._make()
        return _made[self._mark]

    def __getstate__(self) -> tuple[Callable[[], Made], str]:
        return self._make, self._mark

    def __setstate__(self, state: tuple[Callable[[], Made], str]) -> None:
        (self._make, self._mark), self._own = state, None
