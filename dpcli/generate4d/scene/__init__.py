"""This folder holds the 4D scene as a model that can be learned: canonical Gaussians, their motion, control points, losses.

Nothing here reads or writes files.
"""
