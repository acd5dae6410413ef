"""The search with Optuna for a filter's noise levels and for a contestant's options."""
