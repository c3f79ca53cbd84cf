"""What supervises the views nobody filmed: a diffusion model, given views, or geometry alone, behind one interface."""
