"""Drives whose every bit is kept: what a change that means to change no number must leave alone.

`python tests/bits/drives.py --write` takes the digests anew, into `digests.json` beside this file.
A digest guards a refactoring; it says nothing of what the numbers mean.
"""

import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

# Designs go through BLAS, whose kernels round differently from one processor to the next.
os.environ.update(OPENBLAS_NUM_THREADS="1", OPENBLAS_CORETYPE="Haswell")

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

import sideslip
from sideslip.envs import SCENARIOS
from sideslip.envs.scenarios.manoeuvres import TIERS
from sideslip.estimators import FILTERS, EstimateObservation, make_estimator
from sideslip.estimators.vector import EstimateObservation as VectorEstimate

KEPT = Path(__file__).with_name("digests.json")
VISION = str(Path(__file__).parents[1] / "files/old/ppo-yaw-vision.safetensors")
STEPS = 1000
IDS = (
    "sideslip/AfsYawFusion-v0",
    "sideslip/YawFusion-v0",
    "sideslip/YawGps-v0",
    "sideslip/YawVision-v0",
    "sideslip/YawVisionUneven-v0",
)
AGENTS = ("two-dof", "model-following", "esc", "sliding-mode", "lqr", VISION)


class Digest:
    """A hash of numbers in their order, bit for bit."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def take(self, *values: Any) -> None:
        """Add arrays, numbers or dicts of them."""
        for value in values:
            if isinstance(value, dict):
                for key in sorted(value):
                    self._hash.update(key.encode())
                    self.take(value[key])
            elif isinstance(value, np.ndarray) and value.dtype == object:
                for each in value:
                    self.take(each if each is not None else np.zeros(0))
            else:
                array = np.asarray(value)
                self._hash.update(array.dtype.str.encode())
                self._hash.update(array.tobytes())

    def __str__(self) -> str:
        return self._hash.hexdigest()[:16]


def single(env: Any, agent: Any = None, steps: int = STEPS, record: bool = True) -> str:
    """One env, under random actions or an agent's, episode after episode."""
    digest, rng, seed = Digest(), np.random.default_rng(5), 0
    obs, info = env.reset(seed=seed)
    digest.take(obs, info)
    state, start = None, np.ones(1, bool)
    for _ in range(steps):
        if agent is None:
            action = rng.uniform(-0.4, 0.4, env.action_space.shape).astype(np.float32)
        else:
            action, state = agent.predict(obs, state, start, deterministic=True)
        obs, reward, terminated, truncated, info = env.step(action)
        start = np.zeros(1, bool)
        digest.take(obs, float(reward), terminated, truncated, info)
        if record:
            digest.take(env.unwrapped.record.fast, env.unwrapped.record.packets)
        if terminated or truncated:
            seed += 1
            start = np.ones(1, bool)
            obs, info = env.reset(seed=seed)
            digest.take(obs, info)
    return str(digest)


def batch(
    name: str,
    mode: AutoresetMode,
    filter: str = "exact-kf",
    agent_name: str | None = "lqr",
    steps: int = STEPS,
    **more: Any,
) -> str:
    """24 cars with a filter and an agent; None: random actions."""
    envs: Any = gym.make_vec(name, num_envs=24, autoreset_mode=mode, **more)
    envs = VectorEstimate(envs, filter, outputs=states_of(filter, envs.unwrapped.slow_sensors[0]))
    agent = None if agent_name is None else sideslip.make_agent(agent_name, envs)
    digest, state, rng = Digest(), None, np.random.default_rng(6)
    obs, infos = envs.reset(seed=3)
    digest.take(obs, infos)
    start = np.ones(24, bool)
    for _ in range(steps):
        if agent is None:
            actions = rng.uniform(-0.4, 0.4, envs.action_space.shape).astype(np.float32)
        else:
            actions, state = agent.predict(obs, state, start, deterministic=True)
        obs, rewards, terminated, truncated, infos = envs.step(actions)
        start = terminated | truncated
        digest.take(obs, rewards, terminated, truncated, infos)
    return str(digest)


def states_of(filter: str, sensors: Any) -> tuple[str, ...]:
    """All states of a filter."""
    return make_estimator(filter, sensors=sensors).names


_PAPERS = {"two-dof": {"feedforward": "zero-slip"}}  # options of agents in their papers' form


def _estimated(name: str, filter: str, agent: str | None, **more: Any) -> str:
    env: Any = gym.make(name, **more)
    sensors = env.unwrapped.slow_sensors
    env = EstimateObservation(env, filter, outputs=states_of(filter, sensors))
    if agent is None:
        return single(env)
    return single(env, sideslip.make_agent(agent, env, **_PAPERS.get(agent, {})))


def _bare(name: str, steps: int = STEPS, **more: Any) -> str:
    return single(gym.make(name, **more), steps=steps, record=name != "sideslip/Outside-v0")


def cases() -> Iterator[tuple[str, Callable[[], str]]]:
    """(name, drive) of every case."""
    for name in IDS:
        short = name.removeprefix("sideslip/")
        yield f"{short}", partial(_bare, name)
        yield f"{short} at every tick", partial(_bare, name, control_period=1)
        yield f"{short} all samples", partial(_bare, name, fast="all", vehicle="passenger-car")
        yield f"{short} lqr on exact-kf", partial(_estimated, name, "exact-kf", "lqr")
        for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            yield f"{short} 24 cars {mode.value}", partial(batch, name, mode)
    for scenario in sorted(SCENARIOS.keys() - {each.name for each in TIERS}):
        drive = partial(_bare, IDS[0], 300, scenario=scenario)
        yield f"scenario {scenario}", drive
    for scenario in ("sine-with-dwell", "double-lane-change", "low-friction", "stiffness-step"):
        for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            drive = partial(batch, IDS[0], mode, scenario=scenario)
            yield f"24 cars {scenario} {mode.value}", drive
    for name in IDS[1:]:
        there = gym.make(name).unwrapped.slow_sensors  # type: ignore[attr-defined]
        for filter, row in FILTERS.items():
            if not row.slow or set(row.slow) & set(there):
                short = name.removeprefix("sideslip/")
                yield f"{filter} on {short}", partial(_estimated, name, filter, None)
                mode = AutoresetMode.SAME_STEP
                drive = partial(batch, name, mode, filter, None, 100, scenario="sensor-outage")
                yield f"{filter} on {short}, 24 cars", drive
    for agent in AGENTS:
        name, filter = IDS[1], "exact-kf"
        if agent == "model-following":
            name, filter = IDS[0], "dakf"
        yield (
            f"agent {Path(agent).stem}",
            partial(_estimated, name, filter, agent, reference="model"),
        )
    for plant in ("single-track", "drift", "multi-body"):
        yield f"outside {plant}", partial(_bare, "sideslip/Outside-v0", 100, model=plant)


def main() -> None:
    """Compare with what was kept, or keep anew."""
    found: dict[str, str] = {}
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    for name, drive in cases():
        found[name] = drive()
        if "--write" in sys.argv or kept.get(name) != found[name]:
            print(f"{name}: {kept.get(name)} -> {found[name]}", flush=True)
    if "--write" in sys.argv:
        KEPT.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
    print(
        f"{sum(kept.get(name) == value for name, value in found.items())} of {len(found)} as kept"
    )
    sys.exit(found != kept)


if __name__ == "__main__":
    main()
