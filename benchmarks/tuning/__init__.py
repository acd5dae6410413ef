"""The search with Optuna for a filter's noise levels and for an entry's options.

Args:
    task: What is tuned.
    search: Options of the search.
    name: Name of a controller, or of a study.
    kind: Class of tasks.
    seeds: Tuning seeds.
    ranges: Range of each number by name.
    numbers: Value by name.
    log: Log of `controllers.tune`.
    path: File.
    options: Options of filter and controller.
"""
