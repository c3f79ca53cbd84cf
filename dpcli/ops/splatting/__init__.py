"""This folder holds the rasterizer of 3D Gaussians: the public function, its torch reference and its CPU kernels.

Scenes and cameras over time live in `generate4d`.
"""
