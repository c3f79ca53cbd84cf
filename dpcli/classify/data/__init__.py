"""This folder holds the way from a clouds file to training clips: choice of videos, frames and points, augmentation, validation split.

Nothing here knows the network.
"""
