"""This folder holds the network Kinet: the static backbone, the dynamic stream of space-time surfaces, their configuration and weights file.

Nothing here trains or reads videos.
"""
