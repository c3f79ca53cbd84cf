"""This folder holds what each command of `dpc generate4d` does, one module per command.

Options are read in `cli/generate4d`; nothing here prints results.
"""
