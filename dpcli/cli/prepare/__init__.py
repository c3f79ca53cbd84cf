"""This folder holds the options of `dpc prepare`, one module per kind of raw data.

What a command does lives in the room `prepare`.
"""
