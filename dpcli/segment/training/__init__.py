"""This folder holds the training of a part network: losses, their schedule, stored flows, the loop.

The network lives in `segment/network`.
"""
