"""This folder builds procedural articulated objects: simple solids, and kinds that join them by hinges and slides."""
