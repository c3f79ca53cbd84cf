"""Self-contained HTML pages: templates, scripts and the data they show, packed into one file that needs no network."""
