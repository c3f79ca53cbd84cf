"""This folder holds kinds of pictures that OpenCV doesn't read, or changes unasked: TIFF, portable maps and OpenEXR."""
