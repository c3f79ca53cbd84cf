"""This folder holds the readers of point clouds and lidar scans, of single shapes as of streets and rooms.

Depth videos live in `prepare/actions`.
"""
