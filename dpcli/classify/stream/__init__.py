"""This folder holds prediction while frames still arrive: sources of frames, and the sliding window over them.

The command lives in `classify/commands`.
"""
