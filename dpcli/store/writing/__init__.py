"""This folder holds how a file of the contract comes to be whole: beside its target, with a journal that survives a kill, and not twice.

Nothing here knows what a sample of a kind holds; that is said in the modules of `store`.
"""
