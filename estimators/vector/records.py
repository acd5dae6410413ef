"""Vector envs as the wrappers use them: attributes, cars, snapshot and spec."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec, VectorizeMode, WrapperSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from ...envs.record import Array
from ...envs.sensors.link import SlowSensor
from ...envs.task import ObservationEntry
from ...envs.vehicle.parameters import Vehicle

IntArray = npt.NDArray[np.int64]


class BatchedEnv(Protocol):
    """The attributes of a vector env that steps all cars at once.

    The final_... attributes are a car's record before its newest reset. They are read in the step
    that ended its episode.
    """

    rows: Array  # fast samples of each car, (N, k, FAST_WIDTH)
    ticks_done: IntArray  # number of fast samples of each car, (N,)
    packets: Array  # (N, capacity, PACKET_WIDTH)
    delivered: IntArray  # number of packets of each car, (N,)
    final_rows: Array
    final_ticks_done: IntArray
    final_packets: Array
    final_delivered: IntArray
    slow_sensors: Sequence[Mapping[str, SlowSensor]]  # of each car, by name
    nominal: Sequence[Vehicle]  # of each car
    held_speed: Sequence[float | None]  # m/s, of each car where it is held
    layout: tuple[ObservationEntry, ...]  # of a car's observation
    dt: float  # tick (s)


def get_true_vehicles(base: Any, rows: Sequence[int]) -> list[Vehicle]:
    """Return the true vehicles of some cars in this episode.

    Args:
        base: Vector environment without wrappers.
        rows: Indices of the cars.

    Returns:
        Vehicle of each of these cars.

    Raises:
        TypeError: The vehicles are out of reach.
    """
    if isinstance(base, SyncVectorEnv):
        return [base.envs[i].unwrapped.vehicle for i in rows]  # type: ignore[attr-defined]
    if not hasattr(base, "vehicle"):
        raise TypeError(f"{type(base).__name__} does not offer which vehicles its rows drive")
    return [base.vehicle[i] for i in rows]


def get_env_state(env: Any) -> Any:
    """Return the snapshot of a vector env.

    Args:
        env: Vector environment, wrapped or not.

    Returns:
        The snapshot.

    Raises:
        TypeError: The vector env makes none.
    """
    if not hasattr(env, "get_state"):
        raise TypeError(
            f"{type(env).__name__} makes no snapshots; the vector env that gym.make_vec builds "
            "without a vectorization_mode does"
        )
    return env.get_state()


def make_vector_spec(
    spec: EnvSpec | None, single: type[gym.Wrapper[Any, Any, Any, Any]], kwargs: Mapping[str, Any]
) -> EnvSpec | None:
    """Make the spec of a vector env whose cars have the wrapper `single(**kwargs)`.

    `gym.make_vec` puts no wrappers around an env that is a vector by itself. With this spec it
    makes single environments and wraps each of them.

    Args:
        spec: Spec of the vector env, or None.
        single: Class of the single wrapper.
        kwargs: Keyword arguments of the wrapper.

    Returns:
        A JSON-able spec; None without one.
    """
    if spec is None:
        return None
    spec = copy.deepcopy(spec)
    entry = f"{single.__module__}:{single.__name__}"
    wrapper = WrapperSpec(single.class_name(), entry, copy.deepcopy(dict(kwargs)))
    spec.additional_wrappers += (wrapper,)
    if spec.kwargs.get("vectorization_mode") == VectorizeMode.VECTOR_ENTRY_POINT.value:
        spec.kwargs["vectorization_mode"] = VectorizeMode.SYNC.value
        spec.kwargs.pop("info", None)
        if "autoreset_mode" in spec.kwargs:
            spec.kwargs["vector_kwargs"] = {"autoreset_mode": spec.kwargs.pop("autoreset_mode")}
    vector_kwargs = spec.kwargs.get("vector_kwargs", {})
    if isinstance(vector_kwargs.get("autoreset_mode"), AutoresetMode):
        vector_kwargs["autoreset_mode"] = vector_kwargs["autoreset_mode"].value
    return spec
