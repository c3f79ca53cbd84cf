"""This folder holds the options and printed output of `dpc evaluate`, one module per command.

What a command computes lives in the room `evaluate`.
"""
