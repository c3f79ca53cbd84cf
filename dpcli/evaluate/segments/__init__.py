"""This folder holds the metrics, protocol and tables of recordings cut into actions.

Other predictions are scored in the folders beside it; parts of objects in `segmentation/`.
"""
