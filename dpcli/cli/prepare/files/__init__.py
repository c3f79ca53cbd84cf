"""This folder holds the commands of `dpc prepare` that join and divide files of clouds, one module per command.

What a command does lives in the room `prepare`.
"""
