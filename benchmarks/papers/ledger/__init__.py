"""The means to measure claims: simulations, filters, controllers, plots, the verdicts' rule."""
