"""Kinet: actions and gestures in point cloud videos, by fitting space-time surfaces in feature space (thesis chapter 3).

`network` holds the two streams (`kinet`), the solver (`st_surface`, eq. 3.5-3.7), the dynamic branch (`kinematic`) and
the static networks (`backbones`); `data` what the networks see of a `clouds` file; `training` the two stages; `stream`
prediction while frames still arrive; `explain` pictures of what a network looks at; `commands` what each command does.
Settings: each is a field of `network/config.py`, `training/schedule.py`, `data/augment.py` or `training/run_settings.py`;
`presets.py` names values that belong together, `settings.py` puts a user's over them.
"""
