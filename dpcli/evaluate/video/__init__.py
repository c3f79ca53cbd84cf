"""This folder holds the metrics and protocols of pictures in sequence, and of Gaussian scenes rendered to them.

Networks that judge pictures live in `evaluate/networks`.
"""
