"""This folder holds the commands of `dpc prepare` that make data out of nothing, one module per command.

What a command does lives in the room `prepare`.
"""
