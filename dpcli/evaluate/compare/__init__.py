"""This folder holds what compares several result files: paired differences of two, and the spread of several runs.

Metrics of one file live in the folders beside it.
"""
