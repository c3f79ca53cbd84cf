"""This folder holds the commands of `dpc prepare` that make files of views, one module per command.

What a command does lives in the room `prepare`.
"""
