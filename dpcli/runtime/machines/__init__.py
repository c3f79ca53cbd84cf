"""This folder holds the ways in which work on many items is cut and spread over processes and machines."""
