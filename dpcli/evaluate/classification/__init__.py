"""This folder holds the metrics, protocol, tables and pictures of scores files.

Other predictions are scored in the folders beside it.
"""
