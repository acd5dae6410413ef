"""What a learned env-step costs: PPO of stable-baselines3 through our bridge, and on Pendulum-v1.

All learn as they go: a call is one rollout and the gradient steps on it. On Pendulum-v1 PPO has
its defaults, as its users start; through the bridge a rollout comes from many environments, so
that batches are large and few. `sideslip train` has the same PPO with an update by NumPy.
"""

from dataclasses import replace
from typing import Any

from ...envs.ticks import TICK
from ..harness.results import Suite
from .contestants import Field
from .timing import Contestant, Effort, Taken

YAW = "sideslip/YawFusion-v0"
OURS = "PPO, YawFusion-v0"
UPDATED = f"{OURS}, update by NumPy"
PENDULUM = "PPO, Pendulum-v1"

COUNT = 256  # environments of the bridge
DEFAULTS = 2048  # steps of a rollout with the defaults
ROUNDS = 5  # at most: a round takes seconds


def _learner(env: Any, steps: int, kind: Any = None, **settings: Any) -> Contestant:
    from stable_baselines3 import PPO

    model = (kind or PPO)("MlpPolicy", env, seed=0, device="cpu", **settings)

    def work() -> None:
        model.learn(steps, reset_num_timesteps=False)

    return Contestant(work, steps)


def _ours(updated: bool) -> Contestant:
    from ...agents.training.ppo.update import PPO
    from ...agents.vec_env.env import make_vec_env

    settings = _settings()
    env = make_vec_env(YAW, COUNT, seed=0)
    return _learner(env, COUNT * settings["n_steps"], PPO if updated else None, **settings)


def _settings() -> dict[str, Any]:
    """Those of `sideslip train`."""
    from ...agents.training.algorithms import options_of, settings_of

    options = options_of("ppo", settings_of("ppo", YAW), 10 * TICK, COUNT)
    return {name: options[name] for name in ("n_steps", "n_epochs", "batch_size", "gamma")}


def add(suite: Suite, effort: Effort) -> tuple[dict[str, Taken], dict[str, str]]:
    """Rows and a table; what each contestant took, and why others are absent."""
    field = Field()
    field.add(OURS, lambda: _ours(False), "stable-baselines3")
    field.add(UPDATED, lambda: _ours(True), "stable-baselines3")
    field.add(PENDULUM, lambda: _learner("Pendulum-v1", DEFAULTS), "stable-baselines3")
    settings = ", ".join(
        f"{name} = {value}" for name, value in (_settings() if field.contestants else {}).items()
    )
    note = (
        "PPO of stable-baselines3, rollout and gradient steps. YawFusion-v0 through the bridge: "
        f"{COUNT} environments, {settings}; the rest, and all on Pendulum-v1, is its default. "
        "Update by NumPy: the same minibatches, losses and steps to rounding, as in sideslip train."
    )
    fewer = replace(effort, rounds=max(1, min(effort.rounds // 2, ROUNDS)))
    return field.measure(suite, "Cost of a learned env-step", "step", fewer, note)
