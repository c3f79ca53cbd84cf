"""This folder holds what each command of `dpc classify` does, one module per command.

Options are read in `cli/classify`; nothing here prints results.
"""
