"""One HTML file and its figures, heat maps, colours and tracks."""
