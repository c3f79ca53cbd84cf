"""This folder holds the way from clips and camera rigs to a views file: pictures of one object with alpha and cameras.

Filmed meshes live in `prepare/meshes`.
"""
