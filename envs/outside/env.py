"""OutsideEnv: our sensors, scenarios, references and cost around a plant that is not ours."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..backend.arrays import read, write
from ..backend.elementary import clip
from ..backend.primitives import absolute
from ..backend.random import CHANNELS, normals
from ..engine.layout import FLAGS, Disturbance, Drive, P, Task, Z
from ..engine.observe import observe, write_report
from ..engine.packets import due, sense_slow
from ..record import FAST
from ..scenarios.driver import Driver, steered
from ..scenarios.manoeuvres import scenario_from
from ..scenarios.scenario import Scenario
from ..scenarios.speed import Pace, acceleration_command
from ..scenarios.steering import DRIVER, steering_at
from ..scenarios.tracks import Path, path_offset
from ..scenarios.wind import Wind, wind_at
from ..sensors.inertial import Chance, fast_row
from ..stability import StabilityEnv
from ..task.cost import cost_rate, rest_of_cost
from ..task.failures import NOT_FINITE, OFF_ROAD, RUNNING, SPIN
from ..task.info import REPORT
from ..task.reference import Target, reference
from ..ticks import TICK
from ..vehicle.actuators import Lag, distribute, lagged, slewed, within_stop, yaw_moment
from ..vehicle.dynamics import Motion, Road, sideslip_angle
from .checks import check_options, check_scenario
from .plants import OUTSIDE_PLANTS, Acting, OutsidePlant, outside_vehicle


class OutsideEnv(StabilityEnv):
    """`StabilityEnv` whose truth is a model of `sideslip.envs.outside.OUTSIDE_PLANTS`.

    Action, observation, record, reward, info and options of reset are those of `StabilityEnv`; a
    plant whose state is no longer finite ends the episode as "not-finite". Needs the extra
    `outside`. A loop in Python, hundreds of times slower than ours.

    model: "single-track", "drift" or "multi-body". nominal: what estimators and controllers are
    told (default: `outside_vehicle()`). The other arguments are those of `StabilityEnv`, but there
    is no `vehicle`: the true one is the model's. The scenario's friction is the tyre's peak
    lateral friction, which `vehicle` tells; on the single track, whose tyres are linear, it has no
    effect, and there is no reset option "friction". One tyre serves both axles, so its stiffness
    is scaled by the mean of the scenario's two factors. Motors and steering act for a tick with
    the mean that the record tells. The multi-body model always rolls, the others never do.

    Raises ValueError for an unknown model, a scenario with a road or a plant that the model has
    not (curvature, bank, grade, small_angle, tyres, vehicle, friction_right,
    tyre_change_time; wind_height but for the multi-body model), one that has the multi-body model
    below 1 m/s or without roll, the reset option "vehicle" or a start off the road's own frame.
    """

    def __init__(
        self,
        model: str = "drift",
        sensors: str = "fusion",
        scenario: str | Mapping[str, Any] | Scenario = "random-steering",
        reference: str = "model",
        **options: Any,
    ) -> None:
        if model not in OUTSIDE_PLANTS:
            raise ValueError(f"unknown model {model!r}; known: {', '.join(OUTSIDE_PLANTS)}")
        if "vehicle" in options:
            raise TypeError("an outside plant is its own vehicle; only nominal can be given")
        self.model = model
        check_scenario(scenario_from(scenario), model)
        super().__init__(sensors, scenario, outside_vehicle(), reference=reference, **options)
        self.plant: OutsidePlant = OUTSIDE_PLANTS[model]()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see `StabilityEnv`."""
        asked = dict(options or {})
        check_options(asked, self.model)
        scenario = scenario_from(asked.get("scenario", self.setting.base.scenario))
        if "duration" in asked:
            scenario = scenario.replace(duration=float(asked["duration"]))
        check_scenario(scenario, self.model)
        if "state" in asked:  # s and y are X and Y on the straight road of these plants
            state = asked["state"]
            asked["state"] = {**state, "s": state.get("X", 0.0), "y": state.get("Y", 0.0)}
        told = super().reset(seed=seed, options=asked)
        p, base = self._params, self._now.vehicle
        scale = 0.5 * (p[P.car.C_f] / base.front_stiffness + p[P.car.C_r] / base.rear_stiffness)
        p[P.car.C_f], p[P.car.C_r] = scale * base.front_stiffness, scale * base.rear_stiffness
        self.plant = OUTSIDE_PLANTS[self.model](float(p[P.car.mu]), float(scale))
        self.plant.start(self.motion)
        return told

    def get_state(self) -> dict[str, Any]:
        """A snapshot that `set_state` continues from, bit for bit."""
        plant = (self.plant.p, self.plant.specific_force, self.plant.x.copy())
        return super().get_state() | {"outside": plant, "model": self.model}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Go back to a snapshot of this env or of one built with the same arguments."""
        if snapshot.get("model") != self.model:
            raise ValueError(f"the snapshot is of {snapshot.get('model')!r}, not {self.model!r}")
        super().set_state(snapshot)
        self.plant.p, self.plant.specific_force, x = snapshot["outside"]
        self.plant.x = x.copy()

    def _advance(self, force: npt.NDArray[np.float32], obs: npt.NDArray[np.float32]) -> int:
        """One control period of the outside plant: the order of `kernel.step_vehicle`."""
        if not np.isfinite(force).all():
            return super()._advance(force, obs)  # refuses or fails before it moves anything
        told = _Told(*(read(self._params, getattr(P, name)) for name in _Told._fields))
        shares = [float(clip(float(share), -1.0, 1.0)) for share in (*force, 0.0)[:2]]
        z, cost, count, failure, done = self._state, 0.0, 0, RUNNING, 0
        beta, refs, moment, steer = 0.0, (0.0, 0.0), 0.0, 0.0
        while done < self.control_period and failure == RUNNING and not self._at_end:
            before = self.motion
            acted = self._command(told, before.v_x, shares)
            steer = acted[0]
            motion = self.plant.motion if self.plant.finite else before
            write(z, motion, Z.motion)
            count = self._sense(motion, acted[:5], done, count)
            beta = sideslip_angle(motion.v_x, motion.v_y, 0)
            row = self.rows[done]
            v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])
            kind = int(self._now.switches[FLAGS.reference])
            z[Z.driver] = self._driver(told, motion)
            refs = reference(float(z[Z.driver]), float(v), told.target, kind)
            moment = yaw_moment(acted[1], acted[2], self.plant.car)
            share = moment / told.task.yaw_scale
            cost += TICK * cost_rate(beta - refs[0], motion.gamma - refs[1], share, acted[5], kind)
            done += 1
            failure = self._failure(told, motion, beta)
        z[Z.clock.failure] = failure
        if failure != RUNNING:
            cost += rest_of_cost(told.task.duration, float(z[Z.clock.tick]))
        self._tell(done, count, refs, obs)
        write_report(self._report, z)
        self._report[REPORT.beta] = beta
        self._report[[REPORT.beta_ref, REPORT.gamma_ref]] = refs
        self._report[REPORT.steer], self._report[REPORT.yaw_moment] = steer, moment
        self._report[REPORT.cost], self._report[REPORT.reward] = cost, -cost
        self._report[REPORT.packets], self._report[REPORT.ended] = count, float(self._at_end)
        return done

    @property
    def _at_end(self) -> bool:
        return bool(self._state[Z.clock.tick] >= self._params[P.task.duration])

    def _command(
        self, told: "_Told", v_x: float, shares: list[float]
    ) -> tuple[float, float, float, float, float, float]:
        """Let the actuators follow and the plant move for a tick.

        Returns what acted, as `Fast` has it from `steer` on, and the added steering.
        """
        z, task, car = self._state, told.task, self.plant.car
        drive = read(z, Z.drive)
        tick = float(z[Z.clock.tick])
        driver = float(z[Z.driver])
        slewing = slewed(drive.slewing, shares[1] * task.authority, task.slew)
        extra = within_stop(slewing, driver, task.stop)
        limit = 2.0 * car.T_max / (car.m * car.r)
        a_x, integral = acceleration_command(tick, v_x, drive.integral, told.pace, limit)
        to_l, to_r = distribute(shares[0] * task.yaw_scale, a_x, car, task.yaw_first)
        F_w, N_w, N_x = wind_at(tick, told.wind)
        mean, end = (told.motor.mean, told.steering.mean), (told.motor.end, told.steering.end)
        steer = lagged(driver + extra, drive.delta_f, mean[1])
        left, right = lagged(to_l, drive.T_l, mean[0]), lagged(to_r, drive.T_r, mean[0])
        added = lagged(extra, drive.added, mean[1])
        self.plant.step(Acting(steer, left, right, drive.F_d + F_w, drive.N_d + N_w, N_x), TICK)
        z[Z.clock.tick] = tick + 1.0
        ou, wheels = told.disturbance, self._normals(CHANNELS.wheels)
        after = Drive(
            lagged(to_l, drive.T_l, end[0]),
            lagged(to_r, drive.T_r, end[0]),
            lagged(driver + extra, drive.delta_f, end[1]),
            integral,
            ou.keep * drive.F_d + ou.fresh * ou.force * wheels[2],
            ou.keep * drive.N_d + ou.fresh * ou.moment * wheels[3],
            slewing,
            lagged(extra, drive.added, end[1]),
        )
        write(z, after, Z.drive)
        return steer, left, right, driver, a_x, added

    def _driver(self, told: "_Told", motion: Motion) -> float:
        """The driver's steering command at the tick just reached."""
        z, task = self._state, told.task
        if self._now.switches[FLAGS.steering] == DRIVER:
            angle, person, path = float(z[Z.driver]), told.driver, told.path
            return float(steered(angle, motion, path, _FLAT, told.target, person, task.stop))
        programme = read(self._params, P.programme)
        return float(steering_at(float(z[Z.clock.tick]), programme))

    def _normals(self, channel: int) -> tuple[float, ...]:
        clock = read(self._state, Z.clock)
        keys = int(clock.key_low), int(clock.key_high)
        return tuple(normals(*keys, int(clock.tick), channel))

    def _sense(self, motion: Motion, acted: tuple[float, ...], row: int, count: int) -> int:
        """The sensors at the tick just reached; returns how many packets there are now."""
        force = self.plant.specific_force if self.plant.finite else (0.0, 0.0)
        p, z, tick = self._params, self._state, float(self._state[Z.clock.tick])
        chance = Chance(self._normals(CHANNELS.inertial), self._normals(CHANNELS.wheels))
        noise, d_f = read(p, P.noise), float(p[P.car.d_f])
        self.rows[row] = fast_row(motion, force, acted, d_f, noise, chance)
        return (
            int(sense_slow(p, z, motion, tick, 0, self.packets, count)) if due(z, tick) else count
        )

    def _failure(self, told: "_Told", motion: Motion, beta: float) -> int:
        if not self.plant.finite:
            return NOT_FINITE
        if absolute(beta) > told.task.spin and motion.v_x > 0.0:  # backing up is no spin
            return SPIN
        follows = self._now.switches[FLAGS.steering] == DRIVER
        way = path_offset(told.path, motion.s) if follows else 0.0
        return OFF_ROAD if absolute(motion.y - way) > told.task.half_width else RUNNING

    def _tell(
        self, done: int, count: int, refs: tuple[float, float], obs: npt.NDArray[np.float32]
    ) -> None:
        """The observation; where every sample is asked for, the last stands for missing ones."""
        switches, n = self._now.switches, done
        if switches[FLAGS.all_samples]:
            self.rows[done:] = self.rows[done - 1]
            n = self.control_period
        args = (self.rows, n, count, self.packets, refs, self._bounds, obs)
        observe(self._params, self._state, switches, *args)


class _Told(NamedTuple):
    """The parts of the packed parameters that a tick reads."""

    motor: Lag
    steering: Lag
    wind: Wind
    pace: Pace
    target: Target
    disturbance: Disturbance
    task: Task
    driver: Driver
    path: Path


_FLAT = Road(0.0, 0.0, 1.0)
