"""This room holds metrics as plain functions on arrays, protocols that say what was counted, and tables and pictures."""
