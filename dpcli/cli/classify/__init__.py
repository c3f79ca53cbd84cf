"""This folder holds the options and printed output of `dpc classify`, one module per command.

What a command does lives in `classify/commands`.
"""
