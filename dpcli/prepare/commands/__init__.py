"""This folder holds what the commands of `dpc prepare` do besides parsing options: converting raw data, merging and
splitting files.

Readers of raw data live in the folders beside it.
"""
