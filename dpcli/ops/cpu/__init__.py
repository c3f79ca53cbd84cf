"""This folder holds the CPU kernels behind the public operations and what they share (numba decorators, vector lanes, cache blocks).

Public functions live one folder up; nothing outside `ops` should need these, but for kernels of a level's own.
"""
