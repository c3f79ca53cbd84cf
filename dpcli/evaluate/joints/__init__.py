"""Evaluates joints: the kinematic tree, joint types, axes and values, beside the true ones of a clouds file."""
