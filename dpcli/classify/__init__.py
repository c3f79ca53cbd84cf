"""Kinet: actions and gestures in point cloud videos, by fitting space-time surfaces in feature space (thesis chapter 3).

`st_surface` holds the solver (eq. 3.5-3.7), `backbone` what is asked of a static network, `pointnet2`, `dgcnn` and
`spidercnn` three of them, `kinematic` the dynamic branch, `kinet` the two streams, `clips` what the networks see of a
`clouds` file, `train_command` and `commands` what `train`, `predict` and `profile` do, `stream*` predictions while frames
still arrive, `explain_*` pictures of what a network looks at.
"""
