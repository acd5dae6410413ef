"""The loop closes over loopback: in lock-step the drive is the offline one, bit for bit."""

from threading import Event, Thread
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.live.controller import OnboardController
from sideslip.agents.live.loop import Port
from sideslip.agents.live.peers import MAX_TICKS, simulate
from sideslip.agents.rollout import Rollout, rollout
from sideslip.envs.record import FAST
from tests.agents.live.both_ends import SEED, SHORT, STEERING, VISION, contestant, drive, onboard


class Reader:
    """An agent to which every entry of the observation matters."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        width = env.observation_space.shape or (0,)
        self.weights = np.random.default_rng(0).normal(size=(2, *width))
        self.width = env.action_space.shape or (1,)

    def predict(self, obs: Any, state: Any = None, *_: Any, deterministic: bool = True) -> Any:
        count = (0 if state is None else state) + 1
        found = np.sin(self.weights @ obs + 0.01 * count)
        return found[: self.width[0]].astype(np.float32), count


ROUGH = {"loss": 0.2, "duplicate": 0.3, "phase": None}
CASES: dict[str, tuple[str, Any, Any, dict[str, Any]]] = {
    "camera": (VISION, "multirate-kf", "lqr", {"reference": "limited"}),
    "camera and GPS, steering": (STEERING, "dakf", "lqr", {"reference": "lagged"}),
    "every tick": (VISION, "exact-kf", "two-dof", {"control_period": 1}),
    "all that is observed": (STEERING, "exact-kf", Reader, {"reference": "lagged"}),
    "all samples": (VISION, "bicycle-kf", Reader, {"fast": "all"}),
    "late, lost and double": (VISION, "exact-kf", "lqr", {"camera": ROUGH}),
}


class Integrator:
    """A user's filter: the gyro's sideslip, leaking."""

    names = ("beta", "gamma")

    def __init__(self, **_: Any) -> None:
        self.x, self.P = np.zeros(2), np.eye(2) * 1e-4

    def reset(self, sensors: Any, first: int) -> None:
        self.x = np.zeros(2)

    def step(self, rows: Any, packets: Any) -> None:
        for row in rows:
            slip = self.x[0] + 1e-3 * (row[FAST.accel_y] / 7.0 - row[FAST.gyro] - 2.0 * self.x[0])
            self.x = np.array([slip, row[FAST.gyro]])


CASES["a user's filter"] = (VISION, Integrator, "lqr", {})


def assert_same(live: Rollout, offline: Rollout) -> None:
    for name, column in live.columns.items():
        assert np.array_equal(column, offline[name]), name


@pytest.mark.parametrize("case", CASES)
def test_in_lock_step_the_drive_is_the_offline_one(case: str) -> None:
    env_id, estimator, agent, options = CASES[case]
    offline = rollout(*contestant(env_id, estimator, agent, **options), SEED)
    car = onboard(env_id, estimator, agent, **options)
    found, wires, loop = drive(env_id, car, **options)
    assert_same(found, offline)
    assert loop.statistics.ticks == 501 and wires.periods == len(offline["t"]) - 1
    assert not any(loop.assembler.counts.values())


def test_estimates_are_those_of_the_offline_filter_at_every_tick() -> None:
    env, agent = contestant(VISION, "exact-kf", "lqr")
    offline = rollout(env, agent, SEED)
    expected = env.estimator.run(offline.log)
    car = onboard()
    x, std = [], []

    def watch(_: Any) -> None:
        x.append(car.x.copy())
        std.append(car.std.copy())

    drive(VISION, car, watch=watch)
    assert np.array_equal(x, expected.x) and np.array_equal(std, expected.std)


def test_in_real_time_only_late_controls_make_a_difference() -> None:
    """At a tenth of the speed a control has ten times as long."""
    offline = rollout(*contestant(VISION, "exact-kf", "lqr"), SEED)
    car = onboard()
    found, wires, loop = drive(VISION, car, step=False, speed=0.1)
    assert wires.late or loop.assembler.counts["held"] or found["beta"].shape == (51,)
    if not (wires.late or loop.assembler.counts["held"]):
        assert_same(found, offline)
    assert loop.statistics.deadlines - loop.statistics.misses == loop.statistics.jitter.number > 0


def test_garbage_between_the_datagrams_changes_nothing() -> None:
    offline = rollout(*contestant(VISION, "exact-kf", "lqr"), SEED)
    car = onboard()
    over = Event()

    def throw(address: Any) -> None:
        draw = np.random.default_rng(5)
        with Port() as port:
            while not over.wait(0.0005):
                port._socket.sendto(draw.bytes(int(draw.integers(0, 2000))), address)

    threads: list[Thread] = []
    from tests.agents.live import both_ends

    class Known(Port):
        def __init__(self) -> None:
            super().__init__()
            if not threads:  # the car's end comes first
                threads.append(Thread(target=throw, args=(self.address,)))
                threads[0].start()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(both_ends, "Port", Known)
        found, _, loop = drive(VISION, car)
    over.set()
    threads[0].join()
    assert_same(found, offline)
    assert loop.assembler.counts["foreign"] > 0


def test_nobody_at_the_other_end_is_an_error() -> None:
    with Port() as port, Port() as nobody, pytest.MonkeyPatch.context() as patch:
        patch.setattr("sideslip.agents.live.peers.CONTROL_TIMEOUT", 0.2)
        with pytest.raises(TimeoutError, match=r"no control came .* --step"):
            simulate(gym.make(VISION, scenario=SHORT), port, nobody.address, step=True)
        period = MAX_TICKS + 1
        with pytest.raises(ValueError, match="at most"):
            env = gym.make(VISION, scenario=SHORT, control_period=period)
            simulate(env, port, nobody.address, step=True)


def test_an_onboard_is_built_on_an_estimate() -> None:
    with pytest.raises(TypeError, match="EstimateObservation"):
        OnboardController(gym.make(VISION))
