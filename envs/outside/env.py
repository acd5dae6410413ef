"""OutsideEnv: our sensors, scenarios, references and cost around a plant that is not ours."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arguments import check_choice, warn_once
from ..backend.arrays import at, read, write
from ..backend.decorators import plain
from ..engine.layout import P, Z
from ..engine.step import conclude, fixed_of, kind_of, shares_of, wild_of, write_end
from ..engine.tick import Fixed, Kind, Moving, command, sense
from ..engine.window import WINDOW, chance_at, foresee, judge
from ..record import FAST
from ..scenarios.manoeuvres import ScenarioSource, scenario_from
from ..stability import StabilityEnv
from ..task.failures import RUNNING, failure_of
from ..ticks import TICK
from .checks import check_options, check_scenario
from .plants import OUTSIDE_PLANTS, Acting, OutsidePlant, Plant, outside_vehicle

_fixed_of, _kind_of, _write_end = plain(fixed_of), plain(kind_of), plain(write_end)
_command, _sense, _judge = plain(command), plain(sense), plain(judge)
_failure_of = plain(failure_of)


class PlantEnv(StabilityEnv):
    """`StabilityEnv` whose truth is the motion of `plant`, a loop in Python: sensors, references,
    cost and packets are ours."""

    _our_tyres = False
    plant: Plant

    def _advance(self, force: npt.NDArray[np.float32]) -> int:
        """One control period of the outside plant: `step_vehicle` with another motion."""
        share, turn = shares_of(force)
        if share != share:
            return super()._advance(force)  # refuses or fails before it moves anything
        if wild_of(force):
            warn_once(self, force)
        p, z, n = self._params, self._state, self.control_period
        kind = _kind_of(p, self._switches)
        foresee(p, z, n, kind.follows, self._window)
        done = self._drive_on(_fixed_of(p), kind, share, turn)
        conclude(self._row, n, done, self._bounds, self._window)
        return done

    def _drive_on(self, fixed: Fixed, kind: Kind, share: float, turn: float) -> int:
        """`step.drive_on` whose motion is the outside plant's; returns the ticks done."""
        z, plant, task = self._state, self.plant, fixed.task
        motion, drive, refs = read(z, Z.motion), read(z, Z.drive), read(z, Z.refs)
        lead = read(z, Z.lead)
        now = Moving(motion, drive, None, float(z[Z.driver]), fixed.car, refs, lead)
        tick, cost, done, over, failure = float(z[Z.clock.tick]), 0.0, 0, False, 0.0
        N_z, added = share * task.yaw_scale, turn * task.authority
        while not over:
            chance = chance_at(self._window, done)
            control = _command(fixed, N_z, added, now, tick, chance)
            acted = control.acted
            # a quotient, not the product of `command`: its last bit is that of all drives so far
            acted = acted._replace(effort=acted.moment / task.yaw_scale)
            plant.step(Acting(acted.steer, acted.T_l, acted.T_r, *control.push), TICK)
            motion, force = now.motion, (0.0, 0.0)
            if plant.finite:
                motion, force = plant.motion, plant.specific_force
            ahead = at(self._window, WINDOW.ahead, done)
            driver, seen = _sense(fixed, motion, force, acted, now.refs, ahead, chance, kind)
            seen = seen._replace(lost=not plant.finite)
            now = Moving(motion, control.drive, None, driver, now.car, seen.refs, lead)
            write(self.rows[done], seen.row, FAST)
            write(self._window, motion, WINDOW.track, done)
            found = _judge(motion, seen.past, task, fixed.path, kind)
            tick, cost, done = tick + 1.0, cost + found.cost * TICK, done + 1
            failure = _failure_of(seen.lost, found.spun, found.off)
            over = failure != RUNNING or tick >= task.duration or done == self.control_period
        write(z, now.motion, Z.motion)
        _write_end(
            z, self._report, now, seen, failure, found.beta, seen.refs, tick, cost, task.duration
        )
        return done


class OutsideEnv(PlantEnv):
    """`StabilityEnv` whose truth is a model of `sideslip.envs.outside.plants.OUTSIDE_PLANTS`.

    Action, observation, record, reward, info and options of reset are those of `StabilityEnv`; a
    plant whose state is no longer finite ends the episode as "not-finite". Needs the extra
    `outside`. A loop in Python, hundreds of times slower than ours.

    model: "single-track", "drift" or "multi-body". nominal: the vehicle that estimators and
    controllers are designed from (default: `outside_vehicle()`). The other arguments are those of
    `StabilityEnv`, but there is no `vehicle`: the true one is the model's. The scenario's friction
    is the tyre's peak lateral friction, that of `vehicle`; on the single track, whose tyres are
    linear, it has no effect, and there is no reset option "friction". One tyre serves both axles,
    so its stiffness is scaled by the mean of the scenario's two factors. Motors and steering act
    for a tick with their mean in the record. The multi-body model always rolls, the others never
    do.

    Raises ValueError for an unknown model, a scenario with a road or a plant that the model has
    not (curvature, bank, grade, small_angle, tyres, vehicle, friction_right,
    tyre_change_time; wind_height but for the multi-body model), one that has the multi-body model
    below 1 m/s or without roll, the reset option "vehicle" or a start off the road's own frame.
    """

    plant: OutsidePlant

    def __init__(
        self,
        model: str = "drift",
        sensors: str = "fusion",
        scenario: ScenarioSource = "random-steering",
        reference: str = "model",
        **options: Any,
    ) -> None:
        check_choice("model", model, OUTSIDE_PLANTS)
        if "vehicle" in options:
            raise TypeError("an outside plant is its own vehicle; only nominal can be given")
        self.model = model
        check_scenario(scenario_from(scenario), model)
        super().__init__(sensors, scenario, outside_vehicle(), reference=reference, **options)
        self.plant = OUTSIDE_PLANTS[model]()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start an episode; see `StabilityEnv`."""
        asked = dict(options or {})
        check_options(asked, self.model)
        check_scenario(self.config.with_options(asked).scenario, self.model)
        if "state" in asked:  # s and y are X and Y on the straight road of these plants
            state = asked["state"]
            asked["state"] = {**state, "s": state.get("X", 0.0), "y": state.get("Y", 0.0)}
        first = super().reset(seed=seed, options=asked)
        p, base = self._params, self._now.vehicle
        scale = 0.5 * (p[P.car.C_f] / base.front_stiffness + p[P.car.C_r] / base.rear_stiffness)
        p[P.car.C_f], p[P.car.C_r] = scale * base.front_stiffness, scale * base.rear_stiffness
        self.plant = OUTSIDE_PLANTS[self.model](float(p[P.car.mu]), float(scale))
        self.plant.start(self.motion)
        return first

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
