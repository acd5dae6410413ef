"""The matrix of estimators and controllers: tasks, entries, runs, scores, tables, calibration.

Args:
    tasks: Tasks, those of a tier together.
    count: Number of tasks of a tier, or of seeds of a task.
    chunk: Seeds of an entry in a task.
    case: Task and who drives it.
    results: Episodes by case.
    suite: Suite to which rows and tables are added.
    salt: Salt of the seeds, hexadecimal digits, else ValueError.
    matrix: Measurements of the suite.
    ranked: Standings, the best first.
    tier: Tier; None: all.
    title: Title of a table or a figure.
    path: File; None: the package's, if there is one.
"""
