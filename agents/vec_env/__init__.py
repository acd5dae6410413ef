"""Stable-baselines3's kind of vector environment around the batch engine."""

from .env import NativeVecEnv as NativeVecEnv
from .env import make_vec_env as make_vec_env
