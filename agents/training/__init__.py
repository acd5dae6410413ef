"""Training with stable-baselines3, and the export of what it learned; needs the extra `train`."""
