"""This folder holds Frechet distances between features of videos (FVD, FID-VID) in all their published variants.

The networks that compute the features live in `evaluate/networks`.
"""
