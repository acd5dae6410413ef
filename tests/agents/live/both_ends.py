"""Both ends of the wires in one process, for tests."""

from collections.abc import Callable
from threading import Thread
from typing import Any

import gymnasium as gym

from sideslip.agents import make_agent
from sideslip.agents.live.controller import OnboardController, Recorder
from sideslip.agents.live.loop import Loop, Port
from sideslip.agents.live.messages import (
    FIELDS,
    PATIENCE,
    TICK_US,
    Arrival,
    DatagramKind,
    Message,
    StreamSynchroniser,
    Tick,
)
from sideslip.agents.live.peers import _WireAgent, simulate
from sideslip.agents.rollout import Rollout
from sideslip.estimators import EstimateObservation

VISION, STEERING = "sideslip/YawVision-v0", "sideslip/AfsYawFusion-v0"
SHORT = {"base": "tie-vision-fig7", "duration": 0.5}
SEED = 3


def contestant(env_id: str, estimator: Any, agent: Any, **options: Any) -> tuple[Any, Any]:
    """(env with its estimator, agent)."""
    env = EstimateObservation(gym.make(env_id, scenario=SHORT, **options), estimator)
    return env, make_agent(agent, env)


def onboard(
    env_id: str = VISION, estimator: Any = "exact-kf", agent: Any = "lqr", **options: Any
) -> OnboardController:
    return OnboardController(*contestant(env_id, estimator, agent, **options), SEED)


def watch_ticks(onboard: OnboardController, watch: Callable[[Tick], None]) -> None:
    """Call a function after each tick that the controller takes."""
    take = onboard.take

    def take_and_watch(tick: Tick) -> None:
        take(tick)
        watch(tick)

    onboard.take = take_and_watch  # type: ignore[method-assign]


def drive(
    env_id: str, onboard: OnboardController, step: bool = True, recorder: Recorder | None = None,
    watch: Callable[[Tick], None] | None = None, speed: float = 1.0, **options: Any,
) -> tuple[Rollout, _WireAgent, Loop]:  # fmt: skip
    """A drive over loopback, its wires and the loop at the car's end."""
    with Port() as car, Port() as other:
        synchroniser = StreamSynchroniser(None if step else round(PATIENCE / speed))
        loop = Loop(onboard, synchroniser, car, step=step, recorder=recorder)
        if watch is not None:
            watch_ticks(onboard, watch)
        thread = Thread(target=loop.run)
        thread.start()
        env = gym.make(env_id, scenario=SHORT, **options)
        found, wires = simulate(env, other, car.address, SEED, step, speed)
        thread.join(20.0)
        assert not thread.is_alive() and loop.ended == "the drive is over"
    return found, wires, loop


def encode(kind: int, sequence: int, stamp: int, values: Any, names: Any = ()) -> bytes:
    return Message(kind, sequence, stamp, values, names).encode()


def inertial(number: int, sequence: int | None = None, gyro: float = 0.0) -> Arrival:
    """The datagram of a fast row at 7 m/s."""
    values = [gyro, 0.0, 0.0, 0.0, 7.0, 7.0] + [0.0] * (len(FIELDS[DatagramKind.INERTIAL]) - 6)
    sequence = number if sequence is None else sequence
    return Arrival(0, encode(DatagramKind.INERTIAL, sequence, number * TICK_US, values), ("car", 0))


def camera(sequence: int, age: float = 0.03, psi: float = 0.0, stamp: int = 0) -> Arrival:
    """The datagram of a camera's sample."""
    values = [psi] + [0.0] * (len(FIELDS[DatagramKind.CAMERA]) - 3) + [age, 1.0]
    return Arrival(0, encode(DatagramKind.CAMERA, sequence, stamp, values), ("camera", 0))
