"""This folder holds the SE(3)-equivariant part network: encoder, heads, slot matching, configuration and weights file.

Nothing here trains.
"""
