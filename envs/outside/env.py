"""Environments around a plant that is not ours: our sensors, scenarios, references and cost."""

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ..engine import step as engine
from ..engine.layout import P, StepVariant, Z
from ..engine.outputs import finish_step
from ..engine.tick import StepParams, StepState, TickInputs, compute_inputs, measure_tick
from ..engine.window import WINDOW, compute_tick_cost, precompute_window, read_draws
from ..numerics.functions import TICK
from ..numerics.jit import as_python
from ..numerics.packed import load_element, read, write
from ..record import FAST
from ..scenarios.manoeuvres import ScenarioSource, make_scenario
from ..scenarios.scenario import Scenario
from ..stability import StabilityEnv
from ..task import RUNNING, select_failure
from ..validation import check_choice, check_mapping, is_finite, short_repr, warn_once
from ..vehicle.dynamics import Motion
from .plants import OUTSIDE_PLANTS, OutsideInputs, OutsidePlant, make_outside_vehicle

_MIN_SPEED = 1.0  # m/s, of the multi-body model; below 0.1 it freezes while its wheels spin

# Fields of a scenario that change our own plant or its road: only their defaults will do.
_OWN_PLANT_FIELDS = (
    "road", "curvature", "bank", "grade", "small_angle", "tyres", "vehicle", "friction_right",
    "tyre_change_time",
)  # fmt: skip


def _check_scenario(scenario: Scenario, model: str) -> None:
    """Raise ValueError for a scenario that a model of `OUTSIDE_PLANTS` cannot drive."""
    name, changed = f"scenario {scenario.name!r}", scenario.to_dict()
    if field := next((field for field in _OWN_PLANT_FIELDS if field in changed), None):
        value, rule = getattr(scenario, field), "an outside plant is what it is"
        text = f"{field} {value!r} is of our own plant and road"
        raise ValueError(f"{name}: {text}; {rule}, on a straight and level road")
    if model != "multi-body":
        if scenario.wind_height:
            wind = f"wind_height {scenario.wind_height!r} rolls the body"
            raise ValueError(f"{name}: {wind}; the {model} model has no roll")
        return
    if not scenario.roll:
        raise ValueError(f"{name}: roll False; the multi-body model always rolls")
    change = scenario.speed_change + (scenario.acceleration or 0.0) * scenario.duration
    min_speed = scenario.range("speed")[0] + min(change, 0.0)
    if min_speed < _MIN_SPEED:
        rule = f"the multi-body model needs {_MIN_SPEED} m/s or more"
        raise ValueError(f"{name}: its speed comes down to {min_speed:.3g} m/s; {rule}")


def _check_options(options: Mapping[str, Any], model: str) -> None:
    """Raise ValueError for an option of reset that a model of `OUTSIDE_PLANTS` cannot follow."""
    if "vehicle" in options:
        raise ValueError("reset option vehicle: an outside plant is its own vehicle")
    if "friction" in options and model == "single-track":
        reason = "the single-track model's tyres are linear and know none"
        raise ValueError(f"reset option friction: {reason}")
    state = check_mapping("reset option state", options.get("state", {}))
    for name in ("s", "y", "theta"):
        if name in state:
            raise ValueError(f"reset option state: {name} follows from X and Y here")
    if model != "multi-body":
        if state.get("phi") or state.get("phi_dot"):
            raise ValueError(f"reset option state: the {model} model has no roll")
    elif (v_x := state.get("v_x")) is not None and not (is_finite(v_x) and v_x >= _MIN_SPEED):
        rule = f"the multi-body model needs {_MIN_SPEED} or more"
        raise ValueError(f"reset option state: v_x is {short_repr(v_x)} m/s; {rule}")


_make_step_params = as_python(engine.make_step_params)
_make_step_variant = as_python(engine.make_step_variant)
_write_final_state = as_python(engine.write_final_state)
_compute_inputs, _measure_tick = as_python(compute_inputs), as_python(measure_tick)
_compute_tick_cost, _select_failure = as_python(compute_tick_cost), as_python(select_failure)


class _Plant(Protocol):
    """A car that moves in place of our own plant."""

    specific_force: tuple[float, float]  # (a_x, a_y) at the newest step's end, m/s2

    @property
    def motion(self) -> Motion: ...
    @property
    def is_finite(self) -> bool: ...
    def step(self, inputs: OutsideInputs, h: float) -> None: ...


class PlantEnv(StabilityEnv):
    """`StabilityEnv` moved by `plant`, which subclasses set, and start at reset; a Python loop."""

    _has_tyre_forces = False
    plant: _Plant

    def _advance(self, command: npt.NDArray[np.float32]) -> int:
        """Drive one control period of the plant: `step_vehicle` with another motion."""
        shares = engine.clip_action(command)
        if shares[0] != shares[0]:
            return super()._advance(command)  # refuses or fails before it moves anything
        if engine.check_action_range(command):
            warn_once(self, command)
        variant = _make_step_variant(self._row.p, self._row.switches)
        precompute_window(self._row, self.control_period, variant)
        done = self._integrate_step(_make_step_params(self._row.p), variant, shares)
        finish_step(self._row, self.control_period, done)
        return done

    def _integrate_step(
        self, params: StepParams, variant: StepVariant, shares: tuple[float, ...]
    ) -> int:
        """Integrate as `step.integrate_step`, with the plant's motion; return the ticks done."""
        row, plant, task = self._row, self.plant, params.task
        z, window = row.z, row.window
        nominal_motion, driver = read(z, Z.nominal_motion), float(z[Z.driver])
        state = StepState(
            read(z, Z.motion), read(z, Z.drive), None, driver, params.car, read(z, Z.refs),
            nominal_motion, read(z, Z.errors),
        )  # fmt: skip
        tick, cost, done, is_over, failure = float(z[Z.clock.tick]), 0.0, 0, False, 0.0
        N_z, added = shares[0] * task.yaw_scale, shares[1] * task.authority
        while not is_over:
            next_steer = load_element(window, WINDOW.steer, done)
            tick_inputs = TickInputs(N_z, added, read_draws(window, done), next_steer, 0.0)
            inputs = _compute_inputs(params, tick_inputs, state, tick, variant)
            # not the product of `compute_inputs`: all drives so far have a quotient's rounding
            applied = inputs.applied._replace(effort=inputs.applied.moment / task.yaw_scale)
            forces = (applied.steer, applied.T_l, applied.T_r, *inputs.disturbance)
            plant.step(OutsideInputs(*forces), TICK)
            motion, force = state.motion, (0.0, 0.0)
            if plant.is_finite:
                motion, force = plant.motion, plant.specific_force
            signals = motion, force, applied, state.refs, tick_inputs
            driver, measured = _measure_tick(params, *signals, variant)
            measured = measured._replace(lost=not plant.is_finite)
            state = StepState(
                motion, inputs.drive, None, driver, state.car, measured.refs, nominal_motion,
                inputs.applied.errors,
            )  # fmt: skip
            write(row.rows[done], measured.row, FAST)
            write(window, motion, WINDOW.track, done)
            tick_cost = _compute_tick_cost(motion, measured.cost_inputs, task, params.path, variant)
            tick, cost, done = tick + 1.0, cost + tick_cost.cost * TICK, done + 1
            failure = _select_failure(measured.lost, tick_cost.spun, tick_cost.off)
            is_over = failure != RUNNING or tick >= task.duration or done == self.control_period
        write(z, state.motion, Z.motion)
        end = engine.StepEnd(failure, tick_cost.beta, measured.refs, tick, cost)
        _write_final_state(row, state, measured, end, task.duration)
        return done


class OutsideEnv(PlantEnv):
    """`StabilityEnv` whose truth is a model of `sideslip.envs.outside.plants.OUTSIDE_PLANTS`.

    Action, observation, record, reward, info and options of reset are those of `StabilityEnv`; a
    plant whose state is no longer finite ends the episode as "not-finite". Needs the extra
    `outside`. A loop in Python, hundreds of times slower than ours.

    There is no argument `vehicle`: the true one is the model's. The scenario's friction is the
    tyre's peak lateral friction, that of `vehicle`; on the single track, whose tyres are linear, it
    has no effect, and there is no reset option "friction". One tyre serves both axles, so its
    stiffness is scaled by the mean of the scenario's two factors. In every tick motors and steering
    act with their mean of the tick, as in the record. Only the multi-body model rolls, always.

    Args:
        model: "single-track", "drift" or "multi-body".
        sensors: "vision", "vision-uneven", "gps" or "fusion".
        scenario: Scenario as `make_scenario` reads it.
        reference: "zero-slip", "model", "limited" or "lagged".
        options: Arguments of `StabilityEnv`; nominal is `make_outside_vehicle()` by default.

    Raises:
        TypeError: For the argument vehicle.
        ValueError: For an unknown model, and for a scenario with a road or a plant that it lacks:
            curvature, bank, grade, small_angle, tyres, vehicle, friction_right, tyre_change_time.
            For wind_height on other models than multi-body, and for that model below 1 m/s or
            without roll. For a world that is not ideal, and for a lead_in.
    """

    plant: OutsidePlant

    def __init__(
        self, model: str = "drift", sensors: str = "fusion",
        scenario: ScenarioSource = "random-steering", reference: str = "model", **options: Any,
    ) -> None:  # fmt: skip
        check_choice("model", model, OUTSIDE_PLANTS)
        if "vehicle" in options:
            raise TypeError("an outside plant is its own vehicle; only nominal can be given")
        self.model = model
        _check_scenario(make_scenario(scenario), model)
        super().__init__(sensors, scenario, make_outside_vehicle(), reference=reference, **options)
        if not self.config.world.is_ideal or self.config.lead_in:
            raise ValueError("world and lead_in are of our own plant; an outside one has neither")
        self.plant = OUTSIDE_PLANTS[model]()

    def _adapt_options(self, options: dict[str, Any]) -> dict[str, Any]:
        _check_options(options, self.model)
        _check_scenario(self.config.apply_options(options).scenario, self.model)
        if "state" in options:  # s and y are X and Y on the straight road of these plants
            state = options["state"]
            options["state"] = {**state, "s": state.get("X", 0.0), "y": state.get("Y", 0.0)}
        return options

    def _start_episode(self) -> None:
        p, base = self._row.p, self._episode.vehicle
        scale = 0.5 * (p[P.car.C_f] / base.front_stiffness + p[P.car.C_r] / base.rear_stiffness)
        p[P.car.C_f], p[P.car.C_r] = scale * base.front_stiffness, scale * base.rear_stiffness
        self.plant = OUTSIDE_PLANTS[self.model](float(p[P.car.mu]), float(scale))
        self.plant.start(self.motion)
        super()._start_episode()

    def get_state(self) -> dict[str, Any]:
        """Copy the state, plant included, from which `set_state` continues bit for bit."""
        plant = (self.plant.p, self.plant.specific_force, self.plant.x.copy())
        return super().get_state() | {"outside": plant, "model": self.model}

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        if snapshot.get("model") != self.model:
            raise ValueError(f"the snapshot is of {snapshot.get('model')!r}, not {self.model!r}")
        super()._restore(snapshot)
        self.plant.p, self.plant.specific_force, x = snapshot["outside"]
        self.plant.x = x.copy()
