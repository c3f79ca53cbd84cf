"""Joints between rigid parts: their motions over all frames, the axis that explains two of them, the tree, URDF files."""
