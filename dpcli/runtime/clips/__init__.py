"""This folder reads the frames of clips upright and in true colors: video files, animations and folders of images."""
