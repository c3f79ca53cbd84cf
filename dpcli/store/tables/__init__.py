"""This folder holds tables that people read and write, too: CSV and JSON beside the HDF5 files."""
