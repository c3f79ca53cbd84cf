"""This folder holds decoders of single files: depth pictures, archives, arrays, clouds.

They return arrays and know no data set.
"""
