"""Point cloud formats: one module for each, which returns named columns, and what makes points and colors of them."""
