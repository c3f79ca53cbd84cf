"""Metrics as plain functions on arrays, protocols that say what was counted, tables and pictures that show it."""
