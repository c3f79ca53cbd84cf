"""The differences between two records of settings, in words: an earlier run's and this one's."""

from __future__ import annotations

import json
import re

_DIGEST = re.compile('"(?:[0-9a-f]{16}|[0-9a-f]{64})"')
_LONG = 80  # letters of a value that nobody compares by eye
_NOUNS = {
    "digest": "input file",
    "input": "input files",
    "items": "samples, labels or sizes of files",
    "mask": "masks",
    "views": "pictures of other views",
}


def differences(before: object, now: object) -> list[str]:
    """Returns one phrase for each setting that isn't the same, nested ones by their path; what is too long to be told, or a
    digest, is named without its values: before the others, if it isn't nested.

    >>> differences({"frames": 16, "weights": "0" * 64}, {"frames": 24, "weights": "1" * 64})
    ['other weights', 'frames 16, now 24']
    """
    old, new = _settings(before), _settings(now)
    pairs = {name: (old.get(name, "absent"), new.get(name, "absent")) for name in sorted(old.keys() | new.keys())}
    first, told, last = [], [], []
    for name, (was, is_now) in pairs.items():
        if was != is_now and max(len(was), len(is_now)) <= _LONG and not _DIGEST.search(was + is_now):
            told.append(f"{name} {was}, now {is_now}")
        elif was != is_now:
            (last if "." in name else first).append(_other(name))
    return first + told + last


def _other(path: str) -> str:
    above, _, name = path.rpartition(".")
    if above == "inputs":  # files by their role, or their place among equals
        return f"another file {int(name) + 1}" if name.isdigit() else f"another {name} file"
    name = name.removesuffix("_digest")
    return f"other {_NOUNS.get(name, name.replace('_', ' '))}" + (f" ({above})" if above else "")


def _settings(value: object, path: str = "") -> dict[str, str]:
    """Returns a nested record as one level, values as JSON: {"network.num_frames": "16"}. None counts as not there: a run that was
    begun before a setting existed continues as long as the setting isn't used."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        return {path: json.dumps(value, sort_keys=True)}
    return {
        name: one
        for key, item in value.items()
        for name, one in _settings(item, f"{path}.{key}" if path else key).items()
    }
