"""StabilityEnv: the Gymnasium environment of a car that its yaw moment and steering stabilise."""

import copy
import functools
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded

from .camera_simulator import CameraSimulator
from .engine.config import EnvConfig
from .engine.layout import CarTruth, Episode, EpisodeArrays, Z, compute_true_states
from .engine.reset import reset_vehicle
from .engine.step import step_episode
from .numerics.functions import TICK
from .numerics.jit import compile_call
from .numerics.packed import read
from .record import Array, Record
from .rendering.renderer import SingleRenderMixin
from .scenarios.manoeuvres import ScenarioSource, make_scenario
from .scenarios.scenario import Scenario
from .scenarios.world import WorldSource, make_world
from .sensors.link import SlowSensor
from .task import REFUSED, REPORT, RUNNING, WILD, ObservationEntry, make_info
from .validation import parse_action, warn_once
from .vehicle.dynamics import Motion
from .vehicle.parameters import Vehicle, VehicleSource, make_vehicle

_SNAPSHOT = {
    "params": "p", "state": "z", "switches": "switches", "rows": "rows", "packets": "packets",
    "report": "report",
}  # fmt: skip
"""Arrays of the episode by their names in a snapshot."""


@functools.cache
def _compile_step() -> Callable[..., int]:
    """Compile `step_episode` for the types that every environment has."""
    vector, matrix, action = np.zeros(1), np.zeros((1, 1)), np.zeros(1, np.float32)
    arrays = vector, vector, np.zeros(1, np.int64), action, matrix, matrix, vector, matrix, matrix
    return compile_call(step_episode, EpisodeArrays(*arrays), action)


class StabilityEnv(SingleRenderMixin, gym.Env[npt.NDArray[np.float32], npt.NDArray[np.float32]]):
    """Keep a car's sideslip angle where it should be, by two motors and, if asked, by steering.

    ## Action
    `Box(-1, 1, (1,), float32)`: the yaw moment as a fraction of its full scale (372.7 N m for the
    COMS; positive turns left). With `steering` it is `Box(-1, 1, (2,), float32)`: the second
    entry is the steering angle *added* to the driver's, as a fraction of its full scale (0.1 rad,
    positive to the left; at most 0.8 rad/s, within the stop). Zero is the uncontrolled car; values
    outside are clipped, the first beyond +-10 with a warning. What is not finite, no numbers or of
    a wrong shape raises ValueError and steps nothing; with `on_bad_action="fail"` it ends the
    episode as a failure.

    ## Observation
    float32, of one length for all control periods. `layout` has name, unit and bounds of each:

    | entries | unit | meaning |
    |---|---|---|
    | gyro, roll_rate, accel_y, accel_x, wheel_left, wheel_right | rad/s, m/s2, m/s | last sample |
    | ..._mean | | mean over the step (`fast="all"`: every sample instead of last and mean) |
    | steer, torque_left, torque_right | rad, N m | applied, in the last tick |
    | steer_command | rad | the driver's |
    | curvature | 1/m | the road's at the car, with `with_map` |
    | camera_psi, camera_y_l | rad, m | newest camera sample of quality 1 |
    | gps_course, gps_speed, gps_X, gps_Y | rad, m/s, m | newest GPS sample |
    | gps_hdop, gps_satellites | - | its dilution of precision and satellites |
    | ..._age, ..._fresh | s, - | its age, at most 10 s; 1 if it arrived in this step |
    | beta_ref, gamma_ref | rad, rad/s | reference from driver and nominal vehicle |

    Before the first sample a slow sensor's values are 0, its age 10 s, fresh 0.

    ## Record
    `env.unwrapped.record`: the step's fast rows and time-stamped packets, all that estimators read.

    ## Reward
    Minus the integral over the step of
    c = (e_beta/0.02)^2 + (e_gamma/0.1)^2 + 0.01 (N_z/N_max)^2 + 0.01 (steering added/0.05)^2,
    capped at 100 per second, which a failure costs for the rest of the episode too; N_z and the
    added steering are those delivered; with "zero-slip" the yaw rate is not judged. The world "v1"
    adds 0.00025 s2 ((N_z(t) - N_z(t - 10 ms))/(10 ms N_max))^2.

    ## Episode end
    `terminated`: the car spun (sideslip above 0.5 rad, not backing up), left the road's width or
    the driver's lane, or a number is not finite. `truncated`: the scenario's duration is over
    (there is no TimeLimit).

    ## Info
    `t, beta, gamma, psi, beta_ref, gamma_ref, steer, yaw_moment, cost, failure, is_success`
    (floats, `failure` an int code of `sideslip.envs.FAILURES`, `is_success` a bool).

    ## Options of reset
    `scenario`, `vehicle` (the true one: `nominal` stays), `friction`, `duration` (s), `state`
    (mapping of `v_x, v_y, gamma, psi, X, Y, s, y, theta`, `phi, phi_dot` where the car rolls,
    `slip_f, slip_r` where its tyres relax); unknown keys raise ValueError.

    Args:
        sensors: "vision", "vision-uneven", "gps" or "fusion" (camera and GPS).
        scenario: Name, file, mapping or `Scenario`, as `make_scenario` reads it.
        vehicle: The true vehicle: name, file, mapping or `Vehicle`, as `make_vehicle` reads it.
        nominal: The vehicle of estimators and controllers; None for `vehicle`.
        control_period: Ticks (1 ms) between two decisions.
        reference: "zero-slip", "model" (the nominal steady state), "limited" (that, by friction) or
            "lagged" (limited, never oversteering, with a lag of 0.1 s).
        fast: "summary" (last sample and mean) or "all" (every sample of the fast sensors).
        with_map: Whether the observation has the road's curvature; records have it in any case.
        yaw_first: Whether the yaw moment precedes acceleration where both pass the motors' limit.
        steering: Whether the action has the added steering angle.
        on_bad_action: "raise" or "fail".
        vision: "analytic" or "image" (rendered pictures and a lane finder).
        delay: Delay of "image": "fitted" (drawn from measured times; default), "measured" (not
            deterministic) or "link" (the camera's own).
        appearance: With "image", fields of `Appearance` that replace the clear road's.
        render_mode: None, "rgb_array" or "human".
        strict: Whether implausible numbers of the scenario and vehicles are refused.
        world: Errors of car and sensors, drawn by the seed: name ("ideal", "v1"), mapping of ranges
            or `World`, as `make_world` reads it.
        lead_in: Gentle driving before the scenario (s), in which actions do nothing and cost
            nothing: estimators and policies with memory settle.
        slow: By sensor ("camera", "gps"), fields of `SlowSensor` that replace the id's.
    """

    dt = TICK
    """The base tick (s)."""
    _spec: EnvSpec | None = None

    def __init__(
        self, sensors: str = "vision", scenario: ScenarioSource = "random-steering",
        vehicle: VehicleSource = "coms", nominal: VehicleSource | None = None,
        control_period: int = 10, reference: str = "zero-slip", fast: str = "summary",
        with_map: bool = False, yaw_first: bool = True, steering: bool = False,
        on_bad_action: str = "raise", vision: str = "analytic", delay: str | None = None,
        appearance: Mapping[str, Any] | None = None, render_mode: str | None = None,
        strict: bool = True, world: WorldSource = "ideal", lead_in: float = 0.0,
        **slow: Mapping[str, Any] | None,
    ) -> None:  # fmt: skip
        car = make_vehicle(vehicle, strict)
        nominal_vehicle = car if nominal is None else make_vehicle(nominal, strict)
        self.config = EnvConfig(
            sensors, make_scenario(scenario), car, nominal_vehicle, control_period, reference, fast,
            with_map, yaw_first, steering, on_bad_action, vision, delay, strict, slow,
            make_world(world), lead_in,
        )  # fmt: skip
        self.control_period, self.reference = int(control_period), reference
        self._episode = self.config.base
        self._init_rendering(render_mode)
        self.annotations = {}
        self.camera: CameraSimulator | None = None  # with `vision="image"`; has the newest picture
        if vision == "image":
            self.camera = CameraSimulator(delay or "fitted", appearance)
            self.metadata = {**self.metadata, **self.camera.metadata_flags}
        elif appearance is not None:
            raise ValueError("appearance is of pictures: vision='image'")
        self.layout: tuple[ObservationEntry, ...] = self.config.layout
        self.observation_space, self.action_space = self.config.make_spaces()
        self._row = self.config.make_arrays()
        self.ticks_done = 0  # rows of the newest record
        # the record as it stood before the newest reset: a vector env resets within a step
        self.final_rows, self.final_packets = self.rows.copy(), self.packets.copy()
        self.final_ticks_done, self.final_delivered, self._over = 0, 0, True

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start an episode; returns the observation and the info at tick 0.

        Args:
            seed: Seed of the env's generator; None continues it.
            options: Options of reset, listed in the class docstring.
        """
        config = self.config.apply_options(self._adapt_options(dict(options or {})))
        super().reset(seed=seed)  # refused options leave everything as it was
        self._episode = config
        key = int(self.np_random.integers(0, 2**64, dtype=np.uint64))
        self.final_rows[:], self.final_packets[:] = self.rows, self.packets
        self.final_ticks_done, self.final_delivered = self.ticks_done, self.delivered
        self._fit_params(len(config.start.params))
        reset_vehicle(config.start, key & 0xFFFFFFFF, key >> 32, self._row)
        self._over = False
        self._start_episode()
        self.ticks_done, self.annotations = 1, {}
        info = make_info(self._row.report.tolist())
        if self.camera is not None:
            info |= self.camera.metadata_flags
        if self._traces:
            self._record_step()
        return self._row.obs.copy(), info

    def step(
        self, action: npt.ArrayLike
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold the action for one control period; returns what `gymnasium.Env.step` does.

        Args:
            action: Fractions of full scale, shape (1,), or (2,) with `steering`.

        Raises:
            ResetNeeded: If no episode is running.
            ValueError: If the action is refused; nothing is stepped.
        """
        if self._over:
            raise ResetNeeded("the episode is over or was never started: call reset() first")
        camera, row, config = self.camera, self._row, self.config
        command = parse_action(action, config.action_width, config.on_bad_action == "fail")
        before = row.z if camera is None else row.z.copy()
        done = self._advance(command)
        if done <= 0:
            if done == REFUSED:
                raise ValueError(f"action {command.tolist()} is not finite; nothing was stepped")
            row.obs[:] = 0.0
        elif camera is not None:
            camera.process_step(before, row, done)
        self.ticks_done = done
        info = make_info(self._row.report.tolist())
        if camera is not None:
            info |= camera.metadata_flags
        terminated, truncated = info["failure"] != RUNNING, info["is_success"]
        self._over = terminated or truncated
        if self._traces:
            self._record_step()
        return self._row.obs.copy(), -info["cost"], terminated, truncated, info

    def _advance(self, command: npt.NDArray[np.float32]) -> int:
        """Advance one control period; returns the ticks done, or the code of a refusal."""
        done: int = _compile_step()(self._row, command)
        if done >= WILD:
            done -= WILD
            warn_once(self, command)
        return done

    def _fit_params(self, width: int) -> None:
        """Make room for parameters with a trace behind them, or without."""
        if len(self._row.p) != width:
            self._row = self._row._replace(p=np.zeros(width))

    def _adapt_options(self, options: dict[str, Any]) -> dict[str, Any]:
        """Adapt options of reset to what a subclass drives; ValueError for one that it cannot."""
        return options

    def _start_episode(self) -> None:
        """Begin an episode whose tick 0 is packed, with its picture."""
        if self.camera is not None:
            self.camera.capture(self._row.p, self._row.z, self.motion, 0)

    @property
    def spec(self) -> EnvSpec | None:
        """The spec that `gym.make` builds this env from; it says whether it is deterministic."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Set the spec.

        Args:
            spec: Spec that states whether the env is deterministic.
        """
        if spec is not None and self.camera is not None and self.camera.metadata_flags:
            spec.nondeterministic = True
        self._spec = spec

    @property
    def rows(self) -> Array:
        """Fast rows of the newest record, of which `ticks_done` are there, (n, FAST_WIDTH)."""
        return np.asarray(self._row.rows)

    @property
    def packets(self) -> Array:
        """Packets of the newest record, of which `delivered` are there, (max, PACKET_WIDTH)."""
        return np.asarray(self._row.packets)

    @property
    def delivered(self) -> int:
        """Number of packets of the newest record."""
        return int(self._row.report[REPORT.packets])

    @property
    def record(self) -> Record:
        """The record of the newest step, or of tick 0 after a reset (a copy)."""
        return self._get_episode().record

    @property
    def scenario(self) -> Scenario:
        """The scenario of this episode."""
        return self._episode.scenario

    @property
    def vehicle(self) -> Vehicle:
        """The true vehicle now, with what the seed drew; friction is the mean of both sides'."""
        return self._get_episode().vehicle

    @property
    def car_truth(self) -> CarTruth:
        """What an oracle is told of the episode; no sensor measures these."""
        return self._get_episode().car_truth

    @property
    def motion(self) -> Motion:
        """The true velocities, heading, place and roll now, in SI units."""
        return read(self._row.z, Z.motion)

    @property
    def packed_state(self) -> Array:
        """The packed state now, shape (STATE_WIDTH,) as of `envs.engine.layout.Z`, a copy."""
        return np.array(self._row.z)

    @property
    def true_state(self) -> Array:
        """The `TrueState` now, shape (len(TrueState),); no sensor measures these."""
        return np.asarray(compute_true_states(*(x[None] for x in self._row[:3]))[0])

    @property
    def nominal(self) -> Vehicle:
        """The vehicle that estimators and controllers are designed for."""
        return self._episode.nominal

    @property
    def held_speed(self) -> float | None:
        """The speed in m/s that is held exactly (small-angle plant), else None."""
        return self._episode.held_speed

    @property
    def slow_sensors(self) -> dict[str, SlowSensor]:
        """The slow sensors by name, with the clock phase that this episode drew."""
        return self._get_episode().slow_sensors

    def _get_episode(self, row: int = 0) -> Episode:
        arrays = self._row
        rows, packets = arrays.rows[: self.ticks_done], arrays.packets[: self.delivered]
        numbers = arrays.p, arrays.z, arrays.switches, arrays.report
        return Episode(*numbers, self._episode, rows, packets)

    def get_state(self) -> dict[str, Any]:
        """Copy the state of env and generator, from which `set_state` continues bit for bit."""
        arrays = {name: getattr(self._row, part).copy() for name, part in _SNAPSHOT.items()}
        progress, rng = (self.ticks_done, self._over), copy.deepcopy(self.np_random)
        return arrays | {
            "config": self._episode, "layout": self.layout, "progress": progress, "rng": rng
        }  # fmt: skip

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of such an env, whose car, scenario and clocks hold until a reset.

        Args:
            snapshot: From `get_state`; ValueError if control period, sensors or observation differ.
        """
        self._restore(snapshot)

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot; subclasses have more in theirs."""
        if np.shape(snapshot["rows"]) != self.rows.shape:
            ticks, own_ticks = len(snapshot["rows"]), len(self.rows)
            raise ValueError(f"the snapshot has {ticks} ticks a step, this env {own_ticks}")
        if snapshot["layout"] != self.layout:
            raise ValueError("the snapshot is of an env with other sensors or another observation")
        self._fit_params(len(snapshot["params"]))
        for name, part in _SNAPSHOT.items():
            getattr(self._row, part)[:] = snapshot[name]
        self._episode = snapshot["config"]
        self.ticks_done, self._over = snapshot["progress"]
        self.np_random = copy.deepcopy(snapshot["rng"])
