"""This folder holds the engine of settings: fields with help and legal values, their types, and what a user changes.

Which settings there are is said where they are used, in frozen dataclasses of the levels; how they become options is
said in `cli/settings_options.py`.
"""
