"""This folder holds the commands of `dpc prepare` that make clouds of scans and shapes, one module per command.

What a command does lives in the room `prepare`.
"""
