"""This folder holds the commands of `dpc prepare` that make clouds of articulated objects, one module per command.

What a command does lives in the room `prepare`.
"""
