"""This room holds multi-body SE(3) equivariance (thesis chapter 4): rigid parts and their motions in a few frames, without labels."""
