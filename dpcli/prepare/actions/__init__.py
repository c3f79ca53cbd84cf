"""This folder holds the readers of data sets of actions and gestures, mostly depth videos.

Decoders of single files live in `prepare/decode`.
"""
