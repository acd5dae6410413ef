"""One HTML file and its figures, colours and films."""
