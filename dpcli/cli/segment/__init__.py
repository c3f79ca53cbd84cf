"""This folder holds the options and printed output of `dpc segment`, one module per command.

What a command does lives in `segment/commands`.
"""
