"""The gradient engine beside the compiled one: one env-step from many moments of whole episodes.

The compiled engine drives a few episodes; each of their steps is a row of one batch on the device,
which takes that step from the very same state.
"""

from typing import Any, NamedTuple

import numpy as np

from sideslip.envs import StabilityVectorEnv
from sideslip.envs.device import TensorVectorEnv, make_device_env
from sideslip.envs.engine.layout import STATE_WIDTH, Z
from sideslip.envs.record import PACKET, PACKET_WIDTH

from ..batches import batch
from ..helpers import IDS

FUSION, UNEVEN = "sideslip/YawFusion-v0", "sideslip/YawVisionUneven-v0"
DRIVEN = [each for each in IDS if "Linear" not in each]
"""The ids that are driven on a device: the others have a driver who wanders."""
EXACT = 1e-9

_ARRAYS = (
    "params", "states", "switches", "over", "obs", "rows", "packets", "reports", "ticks_done",
    "delivered",
)  # fmt: skip


class Moments(NamedTuple):
    """Steps of the compiled engine: snapshots before and after, and what came between."""

    before: dict[str, Any]
    actions: np.ndarray
    after: dict[str, Any]
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray


def drive(env: StabilityVectorEnv, steps: int, every: int = 1, options: Any = None) -> Moments:
    """Every so many of the steps of an env, and those in which an episode ends."""
    env.reset(seed=5, options=options)
    held = []
    for step in range(steps):
        told = np.random.default_rng(step).uniform(-1.2, 1.2, env.action_space.shape or ())
        told = told.astype(np.float32)
        before = env.get_state()
        _, rewards, terminated, truncated, _ = env.step(told)
        going = ~before["over"]  # rows that are reset are not stepped
        if step % every == 0 or (going & (terminated | truncated)).any():
            numbers = (told[going], rewards[going], terminated[going], truncated[going])
            held.append((_of(before, going), _of(env.get_state(), going), *numbers))
    befores, afters, *rest = zip(*held, strict=True)
    actions, rewards, terminated, truncated = [np.concatenate(each) for each in rest]
    return Moments(_joined(befores), actions, _joined(afters), rewards, terminated, truncated)


def _of(snapshot: dict[str, Any], going: np.ndarray) -> dict[str, Any]:
    kept = {name: snapshot[name][going] for name in _ARRAYS}
    configs = [each for each, goes in zip(snapshot["configs"], going, strict=True) if goes]
    return snapshot | kept | {"configs": configs}


def _joined(snapshots: Any) -> dict[str, Any]:
    joined = {name: np.concatenate([each[name] for each in snapshots]) for name in _ARRAYS}
    configs = [config for each in snapshots for config in each["configs"]]
    nobody: list[None] = [None] * len(configs)
    lists = {"configs": configs, "rng": nobody, "seeds": nobody}
    return {**snapshots[0], **joined, **lists}


def episodes(env_id: str, steps: int, every: int = 1, **arguments: Any) -> Moments:
    """`drive` of three rows of an id."""
    return drive(batch(env_id, 3, **arguments), steps, every)


def device_step(env_id: str, moments: Moments, **arguments: Any) -> tuple[Any, TensorVectorEnv]:
    """(what the device's step returned, the env after it) from these moments."""
    import torch

    env = make_device_env(env_id, len(moments.actions), **arguments)
    env.set_state(moments.before)
    return env.step(torch.as_tensor(moments.actions, device=env.device)), env


def in_flight(states: np.ndarray) -> list[np.ndarray]:
    """Each row's packets under way, by arrival."""
    found = []
    for state in states:
        queue = state[Z.queue : Z.driver].reshape(-1, PACKET_WIDTH)[: int(state[Z.under_way])]
        order = np.lexsort(queue[:, [PACKET.sensor, PACKET.captured, PACKET.arrived]].T)
        found.append(queue[order])
    return found


def largest_error(one: dict[str, Any], other: dict[str, Any]) -> float:
    """The largest difference of two snapshots' numbers; what counts must be equal."""
    for name in ("over", "ticks_done", "delivered", "switches"):
        np.testing.assert_array_equal(one[name], other[name], name)
    outside = np.r_[0 : Z.queue, Z.driver : STATE_WIDTH]
    pairs = [(one[name], other[name]) for name in ("obs", "params", "reports")]
    pairs += [(one["states"][:, outside], other["states"][:, outside])]
    pairs += list(zip(in_flight(one["states"]), in_flight(other["states"]), strict=True))
    for i, (ticks, packets) in enumerate(zip(one["ticks_done"], one["delivered"], strict=True)):
        pairs.append((one["rows"][i, :ticks], other["rows"][i, :ticks]))
        pairs.append((one["packets"][i, :packets], other["packets"][i, :packets]))
    worst = 0.0
    for a, b in pairs:
        assert a.shape == b.shape
        same = (a == b) | (np.isnan(a) & np.isnan(b))
        worst = max(worst, float(np.where(same, 0.0, np.abs(a - b)).max(initial=0.0)))
    return worst


def agrees(env_id: str, moments: Moments, **arguments: Any) -> TensorVectorEnv:
    """The device's step from these moments is the compiled engine's; returns the env after it."""
    returned, env = device_step(env_id, moments, **arguments)
    obs, rewards, terminated, truncated, infos = returned
    np.testing.assert_array_equal(terminated.cpu(), moments.terminated)
    np.testing.assert_array_equal(truncated.cpu(), moments.truncated)
    assert largest_error(moments.after, env.get_state()) < EXACT
    np.testing.assert_allclose(rewards.cpu(), moments.rewards, rtol=0.0, atol=EXACT)
    np.testing.assert_allclose(obs.cpu(), moments.after["obs"], rtol=0.0, atol=1e-6)
    assert (infos["failure"] != 0).tolist() == moments.terminated.tolist()
    return env
