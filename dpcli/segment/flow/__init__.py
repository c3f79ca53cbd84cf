"""This folder holds all that estimates scene flow: nearest points, rigid bodies by ICP, a network and its training.

Nothing here knows of part networks but their slot matching.
"""
