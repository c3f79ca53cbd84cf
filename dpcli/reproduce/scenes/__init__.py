"""This folder holds the programs behind the tables and figures of 4D scenes."""
