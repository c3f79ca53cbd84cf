"""This room turns raw data into files: a reader per format yields samples, and the pipeline thins and writes them."""
