"""This folder holds animated meshes: glTF, skinning, and virtual cameras that film them.

Still meshes of rooms and robots live in `prepare/articulated`.
"""
