"""What is computed of a whole drive or system: the bound, the smoother, dual-rate on any system."""
