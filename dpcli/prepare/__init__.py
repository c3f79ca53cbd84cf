"""Readers of raw data, one file per format; each yields samples and the pipeline writes them."""
