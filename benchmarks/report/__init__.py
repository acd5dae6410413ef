"""What every suite is made of (`study`), and its report: one HTML file, figures, films.

Args:
    console: Console to print to.
    suite: Results.
    suites: Results of a run.
    table: Table.
    path: File, None for none where a function takes it.
"""
