"""This folder holds what the commands of `dpc prepare` do that work on finished files: merging and splitting.

Readers of raw data live in the folders beside it.
"""
