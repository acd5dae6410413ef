"""CPU time of a learned env-step: PPO of stable-baselines3 on YawFusion-v0 and on Pendulum-v1.

A call is one rollout and the gradient steps on it, with the same settings for both. Pendulum-v1
steps in stable-baselines3's own vector environment.
"""

from functools import partial
from typing import Any

from ...envs.ticks import TICK
from .timing import Workload, WorkloadSet

YAW, _PENDULUM_ID = "sideslip/YawFusion-v0", "Pendulum-v1"
PPO_YAW = "PPO, YawFusion-v0"
PENDULUM = f"PPO, {_PENDULUM_ID}"

_COUNT = 256  # environments


def _make_learner(name: str) -> Workload:
    """Make the learner on `PPO_YAW` or `PENDULUM`; a call is a rollout and its update."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    from ...agents import vec_env as bridge

    make, env_id = (make_vec_env, _PENDULUM_ID) if name == PENDULUM else (bridge.make_vec_env, YAW)
    model = PPO("MlpPolicy", make(env_id, _COUNT, seed=0), seed=0, device="cpu", **_get_settings())
    steps = _COUNT * model.n_steps

    def run_updates() -> None:
        model.learn(steps, reset_num_timesteps=False)

    return Workload(run_updates, steps)


def _get_settings() -> dict[str, Any]:
    """Get the settings of PPO that `sideslip train` uses."""
    from ...agents.training.config import TrainingTask

    options = TrainingTask(YAW, num_envs=_COUNT).make_model_options(10 * TICK)
    return {name: options[name] for name in ("n_steps", "n_epochs", "batch_size", "gamma")}


def make_workloads() -> WorkloadSet:
    """Make both learners, unless stable-baselines3 is not installed."""
    field = WorkloadSet("Cost of a learned env-step", "step", "", is_slow=True)
    for name in (PPO_YAW, PENDULUM):
        field.add(name, partial(_make_learner, name), "stable-baselines3")
    settings = _get_settings() if field.workloads else {}
    field.note = (
        "PPO of stable-baselines3, rollout and gradient steps, on as many environments each: "
        f"{_COUNT}, YawFusion-v0 through the bridge; "
        f"{', '.join(f'{name} = {value}' for name, value in settings.items())}, the rest is its "
        "default."
    )
    return field
