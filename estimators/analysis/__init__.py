"""What is computed of a whole drive or system: limits, the smoother, dual-rate on any system."""
