"""This folder holds the classical methods that a part network is compared with.

They know no network.
"""
