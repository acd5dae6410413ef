"""The task: references, cost, failures, and what observation and info contain."""
