"""Claims that need no simulation: observability, error maps between samples, dual-rate gains."""
