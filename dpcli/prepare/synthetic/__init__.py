"""This folder holds data made out of nothing with its ground truth: gestures of a figure and made-up animals.

Procedural articulated objects live in `prepare/articulated`.
"""
