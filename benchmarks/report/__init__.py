"""What every suite is made of (`study`), and its report: one HTML file, figures, films."""
