"""This folder holds explanations of a trained network: point activation clouds, video features in the plane, and their pictures.

The command lives in `classify/commands`.
"""
