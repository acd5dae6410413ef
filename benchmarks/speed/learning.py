"""What a learned env-step costs: PPO of stable-baselines3 through our bridge, and on Pendulum-v1.

All learn as they go: a call is one rollout and the gradient steps on it. All have the same number
of environments and the same settings; those of Pendulum-v1 step in stable-baselines3's own vector
environment.
"""

from dataclasses import replace
from functools import partial
from typing import Any

from ...envs.ticks import TICK
from ..harness.results import Suite
from .timing import Effort, Taken, Workload, WorkloadSet

YAW, PENDULUM_ID = "sideslip/YawFusion-v0", "Pendulum-v1"
PPO_YAW = "PPO, YawFusion-v0"
PENDULUM = f"PPO, {PENDULUM_ID}"

COUNT = 256  # environments
ROUNDS = 5  # at most: a round takes long


def _make_learner(name: str) -> Workload:
    """One of the two; a call is a rollout and its update."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    from ...agents import vec_env as bridge

    make, env_id = (make_vec_env, PENDULUM_ID) if name == PENDULUM else (bridge.make_vec_env, YAW)
    model = PPO("MlpPolicy", make(env_id, COUNT, seed=0), seed=0, device="cpu", **_get_settings())
    steps = COUNT * model.n_steps

    def run_updates() -> None:
        model.learn(steps, reset_num_timesteps=False)

    return Workload(run_updates, steps)


def _get_settings() -> dict[str, Any]:
    """Those of `sideslip train`."""
    from ...agents.training.config import make_model_options, read_settings

    options = make_model_options("ppo", read_settings("ppo", YAW), 10 * TICK, COUNT)
    return {name: options[name] for name in ("n_steps", "n_epochs", "batch_size", "gamma")}


def add(suite: Suite, effort: Effort) -> tuple[dict[str, Taken], dict[str, str]]:
    """Rows and a table; what each contestant took, and why others are absent."""
    field = WorkloadSet()
    for name in (PPO_YAW, PENDULUM):
        field.add(name, partial(_make_learner, name), "stable-baselines3")
    settings = ", ".join(
        f"{name} = {value}" for name, value in (_get_settings() if field.workloads else {}).items()
    )
    note = (
        "PPO of stable-baselines3, rollout and gradient steps, on as many environments each: "
        f"{COUNT}, YawFusion-v0 through the bridge; {settings}, the rest is its default."
    )
    fewer = replace(effort, rounds=max(1, min(effort.rounds // 2, ROUNDS)))
    return field.measure(suite, "Cost of a learned env-step", "step", fewer, note)
