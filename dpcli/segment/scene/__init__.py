"""Streets and other scenes: ground and the sensor's own motion taken out, what moves on its own found in all frames."""
