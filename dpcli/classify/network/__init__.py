"""This folder holds the network Kinet: static backbone, stream of space-time surfaces, configuration, weights file.

Nothing here trains or reads videos.
"""
