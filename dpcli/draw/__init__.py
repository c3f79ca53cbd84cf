"""This room holds everything that draws: points, contact sheets, palettes, curves, animations, pages and colored PLY files.

It may import `ops` and `runtime` only, never a level or a file format.
"""
