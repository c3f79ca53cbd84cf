"""This room holds multi-body SE(3) equivariance (thesis chapter 4): rigid parts, their motions and joints, without labels."""
