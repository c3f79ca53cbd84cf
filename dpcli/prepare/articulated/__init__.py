"""This folder holds objects and rooms of rigid parts that move on joints: URDF files, PartNet-Mobility, procedural
kinds, generated rooms.

Scanned scenes live in `prepare/scans`.
"""
