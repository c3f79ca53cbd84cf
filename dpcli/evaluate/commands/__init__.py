"""This folder holds what the commands of `dpc evaluate` do: each takes files and options and returns a result.

Printing is left to `cli/evaluate`; metrics live in the folders beside this one.
"""
