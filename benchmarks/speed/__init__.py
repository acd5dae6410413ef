"""Question: what does a step cost? Ours beside others', in one run; one module a question.

Args:
    effort: Rounds, and the time of each workload in one.
    suite: Suite that gets the results.
    workloads: Workloads by name, or the functions that make them.
"""
