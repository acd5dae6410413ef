"""The search with Optuna for a filter's noise levels and for an entry's options."""
