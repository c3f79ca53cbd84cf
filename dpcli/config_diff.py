"""The differences between two records of settings, in words: an earlier run's and this one's."""

from __future__ import annotations

import json


def differences(before: object, now: object) -> list[str]:
    """Returns one phrase for each setting that isn't the same, nested ones by their path."""
    old, new = _settings(before), _settings(now)
    pairs = {name: (old.get(name, "absent"), new.get(name, "absent")) for name in sorted(old.keys() | new.keys())}
    return [f"{name} {was}, now {is_now}" for name, (was, is_now) in pairs.items() if was != is_now]


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
