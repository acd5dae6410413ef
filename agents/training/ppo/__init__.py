"""PPO whose update is taken by NumPy."""
