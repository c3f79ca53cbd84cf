"""This room holds the tables and figures of the thesis, one program each, called by the goals of the Makefile.

It may import every other room; nothing imports it.
"""
