"""Lists in one option: whole numbers, shares of the splits, degrees, or words, with commas between them."""

from __future__ import annotations

from math import isfinite

from dpcli.errors import UsageError


def words(text: str) -> tuple[str, ...]:
    """Returns the words of a list, without the spaces around them and without empty ones.

    >>> words("car, truck,")
    ('car', 'truck')
    """
    return tuple(word.strip() for word in text.split(",") if word.strip())


def whole_numbers(text: str, option: str) -> tuple[int, ...]:
    """Returns the numbers of a list. Raises UsageError, which names the option, for anything else.

    >>> whole_numbers("1,3,5", "--train-subjects")
    (1, 3, 5)
    """
    try:
        return tuple(int(word) for word in words(text))
    except ValueError:
        raise UsageError(f"{option} {text}: expected whole numbers with commas, such as 1,2,3") from None


def _finite(text: str) -> tuple[float, ...]:
    """Returns the numbers of a list. Raises ValueError for anything else, NaN and infinity too, which pass all comparisons."""
    numbers = tuple(float(word) for word in words(text))
    if not all(map(isfinite, numbers)):
        raise ValueError(text)
    return numbers


def degrees(text: str, option: str) -> tuple[float, ...]:
    """Returns the angles of a list, in degrees. Raises UsageError, which names the option, for anything else."""
    try:
        return _finite(text)
    except ValueError:
        raise UsageError(f"{option} {text}: expected degrees with commas, such as 15,-75") from None


def three_shares(text: str) -> tuple[float, float, float]:
    """Returns the shares of train, validation and test that `--fractions` names.

    Raises UsageError unless they are three.

    >>> three_shares("0.8,0.1,0.1")
    (0.8, 0.1, 0.1)
    """
    try:
        train, validation, test = _finite(text)
    except ValueError:
        raise UsageError(f"--fractions {text}: expected three numbers, such as 0.8,0.1,0.1") from None
    return train, validation, test
