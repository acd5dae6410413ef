"""What claims are measured with: simulations, filters, controllers, plots, the verdicts' rule."""
