"""This folder holds the options of `dpc prepare`: a folder for each kind of data, and what the commands share.

What a command does lives in the room `prepare`.
"""
