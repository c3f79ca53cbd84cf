"""This folder holds what cuts a long recording into actions: the scores of a sliding window, and the best cuts of them.

The command lives in `classify/commands`.
"""
