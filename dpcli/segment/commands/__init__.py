"""This folder holds what each command of `dpc segment` does, one module per command.

Options are read in `cli/segment`; nothing here prints results.
"""
