"""This folder holds the metrics that see a video frame by frame, most of them by published networks.

The networks themselves live in `evaluate/networks`, distances of their features in the folder `frechet` beside it.
"""
