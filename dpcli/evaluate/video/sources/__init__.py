"""This folder reads the videos to compare, one picture at a time, whatever file they are in."""
