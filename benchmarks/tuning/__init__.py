"""The search for a filter's noise levels with Optuna."""
