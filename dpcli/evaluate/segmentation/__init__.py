"""This folder holds the metrics and protocols of parts files: rigid parts, scene flow and part motions.

Other predictions are scored in the folders beside it.
"""
