"""This folder holds what judges views that nobody filmed: score distillation from a diffusion model, behind an interface."""
