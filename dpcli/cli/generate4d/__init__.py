"""This folder holds the options and printed output of `dpc generate4d`, one module per command.

What a command does lives in `generate4d/commands`.
"""
