"""This folder holds everything that leaves a fitted scene: pictures along camera paths, exports, previews and the scene file.

The model itself lives in `generate4d/scene`.
"""
