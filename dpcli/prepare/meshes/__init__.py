"""This folder holds animated meshes: glTF, skinning, and virtual cameras that film them; and the reader of still meshes.

Rooms and robots of still meshes live in `prepare/articulated`.
"""
