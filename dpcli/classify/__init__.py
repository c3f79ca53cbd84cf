"""Kinet: actions and gestures in point cloud videos, by fitting space-time surfaces in feature space (thesis chapter 3).

`st_surface` holds the solver (eq. 3.5-3.7), `backbone` what is asked of a static network, `pointnet2`, `dgcnn` and
`spidercnn` three of them, `kinematic` the dynamic branch, `kinet` the two streams, `clips` what the networks see of a `clouds` file, `train` / `predict` / `profile` the three commands.
"""
