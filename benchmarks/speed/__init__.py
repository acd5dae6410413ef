"""Question: what does a step cost? Ours beside others', in one run; one module a question."""
