"""What the driver commands in an episode."""

from typing import Any

import numpy as np

from sideslip.envs import StabilityEnv
from sideslip.envs.record import FAST


def commands(env: StabilityEnv, seed: int = 0, **options: Any) -> Any:
    """The driver's steering command at the ticks of an episode but the last, (T,)."""
    env.reset(seed=seed, options=options)
    rows, over = [env.record.fast[:, FAST.steer_command]], False
    while not over:
        _, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
        rows.append(env.record.fast[:, FAST.steer_command])
        over = terminated or truncated
    return np.concatenate(rows)[1:]  # a row has what acted before it
