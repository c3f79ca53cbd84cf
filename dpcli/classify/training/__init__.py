"""This folder holds the training of a Kinet: stages, steps, schedules, curves.

The network lives in `classify/network`, clips in `classify/data`.
"""
