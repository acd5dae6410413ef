"""The car's computer: estimates at every tick, an observation and an action per control period."""

from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ...envs.backend.arrays import read
from ...envs.backend.decorators import as_python
from ...envs.engine.arrays import EpisodeArrays
from ...envs.engine.layout import FLAGS, STATE_WIDTH, P, Z
from ...envs.engine.observe import observe
from ...envs.engine.packets import update_newest
from ...envs.record import FAST, FAST_WIDTH, Array
from ...envs.task.info import REPORT
from ...envs.task.reference import compute_reference, filter_reference
from ...envs.ticks import NEVER
from ...estimators.estimator import Estimator
from ...estimators.protocol import compute_std
from ...estimators.wrappers.estimate import EstimateObservation
from ...estimators.wrappers.kernel import compile_observe
from ...estimators.wrappers.outputs import write_outputs
from ..env_facts import get_env_facts
from .assemble import NO_PACKETS, Tick

_reference, _filter_reference = as_python(compute_reference), as_python(filter_reference)


class OnboardController:
    """An estimator and an agent on the wires' data.

    For equal ticks its results equal those in the env, bit for bit.

    Args:
        env: `EstimateObservation` with the sensors' clocks, the nominal car, the references and the
            control period; it is not driven.
        agent: Agent of `make_agent` for the env; None: without control.
        seed: Seed of the env, whose reset draws the sensors' phases.

    Attributes:
        names: Names of the states.
        action: Newest action, shape (width,), None before the first.
        has_new_action: Whether the action is of this tick.

    Raises:
        TypeError: The env is another one.
    """

    def __init__(self, env: gym.Env[Any, Any], agent: Any = None, seed: int | None = 0) -> None:
        if not isinstance(env, EstimateObservation):
            raise TypeError(f"it reads an EstimateObservation, got {type(env).__name__}")
        base: Any = env.unwrapped
        env.reset(seed=seed)
        self.base = base
        self.facts, self.agent, self.outputs = get_env_facts(env), agent, env.outputs
        self.estimator: Any = env.estimator
        self.sensors, self.names = self.base.slow_sensors, env.estimator.names
        self._is_native = isinstance(self.estimator, Estimator) and self.estimator.compiled
        snapshot = self.base.get_state()
        self._p, self._switches = snapshot["params"], snapshot["switches"]
        self._kind, self._target = int(self._switches[FLAGS.reference]), read(self._p, P.target)
        self._bounds = self.base.config.bounds
        self._rows = np.zeros((self.facts.control_period, FAST_WIDTH))
        self._X: Array = np.zeros((1, len(self.names)))
        self._S = np.zeros_like(self._X)
        self.begin(0)
        self._warm_up()

    @property
    def x(self) -> Array:
        """Estimated states, shape (n,)."""
        estimate: Array = self._X[0]
        return estimate

    @property
    def std(self) -> Array:
        """Standard deviations of the estimated states, shape (n,)."""
        deviation: Array = self._S[0]
        return deviation

    @property
    def refused(self) -> dict[str, int]:
        """Counts of packets that the estimator did not use, for one of this package."""
        return self.estimator.counts if self._is_native else {}

    def begin(self, first: int) -> None:
        """Clear all memory.

        Args:
            first: Number of the next tick.
        """
        self.estimator.reset(self.sensors, first)
        self._z, self._refs = np.zeros(STATE_WIDTH), None
        for sensor in Z.slow:
            self._z[sensor.captured] = NEVER
        self._count, self._packets = 0, [NO_PACKETS]
        self._memory, self._start = None, np.ones(1, np.bool_)
        self.action: npt.NDArray[np.float32] | None = None
        self.has_new_action = False

    def take(self, tick: Tick) -> None:
        """Process a tick: the estimate and, at the end of a control period, the agent's action.

        Args:
            tick: Data of the tick.
        """
        if tick.begins:
            self.begin(tick.number)
        n, row = self.facts.control_period, tick.row
        if self._is_native:
            rows, packets = row.reshape(1, -1), tick.packets
            self.estimator.take(rows, 1, packets, len(packets), self._X, self._S)
        else:
            self.estimator.step(row.reshape(1, -1), tick.packets)
            self._X[0], self._S[0] = self.estimator.x, compute_std(self.estimator.P)
        self._rows[self._count] = row
        self._count += 1
        if len(tick.packets):
            self._packets.append(tick.packets)
            for packet in tick.packets:
                update_newest(self._z, packet, float(tick.number))
        v = 0.5 * float(row[FAST.wheel_left] + row[FAST.wheel_right])
        steady = _reference(tick.steer_next, v, self._target, self._kind)
        before, target, kind = self._refs, self._target, self._kind
        self._refs = steady if before is None else _filter_reference(before, steady, target, kind)
        self.has_new_action = tick.number % n == 0
        if self.has_new_action:
            self._compute_action(tick.number)
        elif self._count == n:  # begun within a period
            self._count = 0

    def _compute_action(self, number: int) -> None:
        obs, start = self.make_observation(number), self._start
        self._count, self._packets, self._start = 0, [NO_PACKETS], np.zeros(1, np.bool_)
        if self.agent is None:
            self.action = np.zeros(self.facts.width, np.float32)
            return
        prediction = self.agent.predict(obs, self._memory, start, deterministic=True)
        self.action, self._memory = prediction

    def make_observation(self, number: int) -> npt.NDArray[np.float32]:
        """Make the observation that the env's agents would get.

        Args:
            number: Number of the tick.

        Returns:
            Observation with the estimator's outputs, shape (k,).
        """
        done, outputs = self._count, self.outputs
        packets = np.concatenate(self._packets)
        self._rows[done:] = self._rows[done - 1]
        shown = len(self._rows) if self._switches[FLAGS.all_samples] else done
        obs = np.empty(self._bounds.shape[1], np.float32)
        self._z[Z.clock.tick] = number
        row = EpisodeArrays(
            self._p, self._z, self._switches, obs, self._rows, packets, np.zeros(len(REPORT))
        )
        observe(row, shown, len(packets), self._refs, self._bounds)
        out, estimator = np.empty(len(outputs.layout), np.float32), self.estimator
        last = outputs.inner, outputs.plan, outputs.limits, 0.0, 0.0, out, np.zeros(3)
        if self._is_native:  # which takes no further row here
            record = self._rows, 0, NO_PACKETS, 0, 0
            compile_observe()(estimator.filters, estimator.gains, *record, obs, *last)
        else:
            write_outputs(estimator, obs, *last)
        return out

    def _warm_up(self) -> None:
        """Compile the code of the first ticks."""
        row, packet = self.base.record.fast[0], np.zeros((1, NO_PACKETS.shape[1]))
        for number in range(self.facts.control_period + 1):
            self.take(Tick(number, row, 0.0, packet, number == 0))
        self.begin(0)
