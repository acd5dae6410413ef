"""Adapter of highway-env's own `lane-keeping-v0`, for our sensors and estimators.

Its car is a linear bicycle at constant speed, and its steering alone acts. Faults of version 1.12.1
are worked around: `render_mode` is set on the built environment, which takes no such argument;
`step` returns the observation from before the step (`NativeObservation` takes either); steps of
0.1 s are unstable below 5.5 m/s, so a step is a tick; its too weak linear model is not used.
"""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt

from ..engine.layout import P, Z
from ..numerics.jit import as_python
from ..outside.env import PlantEnv
from ..outside.plants import OutsideInputs
from ..record import Array
from ..scenarios.scenario import Scenario
from ..sensors.camera.analytic import compute_preview_offset
from ..task import ObservationEntry, make_space
from ..ticks import TICK
from ..vehicle.dynamics import Motion
from ..vehicle.parameters import Vehicle
from .traffic import locate_on_lane

from highway_env.envs.lane_keeping_env import LaneKeepingEnv  # isort: skip  # after `traffic`
from highway_env.vehicle.dynamics import BicycleVehicle  # isort: skip

_compute_preview_offset = as_python(compute_preview_offset)
_MASS = 1000.0  # kg; theirs is 1 kg, and only ratios to it count
KEEPING = Scenario(
    name="lane-keeping-v0", duration=16.0, speed=8.3, tyres="linear", roll=False,
    disturbance_force=0.0, disturbance_moment=0.0,
)  # fmt: skip
"""Only the controller steers; the car and its lane are highway-env's."""
STATES = ("beta", "gamma", "psi", "y_l")


def make_keeping_vehicle() -> Vehicle:
    """Make highway-env's bicycle as our `Vehicle`; the motors, roll and height are assumed."""
    car = BicycleVehicle
    return Vehicle(
        name="highway-env's bicycle", mass=_MASS, yaw_inertia=_MASS * car.INERTIA_Z / car.MASS,
        front_arm=car.LENGTH_A, rear_arm=car.LENGTH_B,
        front_stiffness=_MASS * car.FRICTION_FRONT / car.MASS,  # per tyre, as their 2 C_f has it
        rear_stiffness=_MASS * car.FRICTION_REAR / car.MASS, front_track=1.6, rear_track=1.6,
        wheel_radius=0.3, gravity_height=0.5, motor_torque=100.0, steering_authority=0.5,
        width=car.WIDTH, sprung_mass=0.9 * _MASS, roll_arm=0.3, roll_inertia=500.0,
        roll_stiffness=5e4, roll_damping=3e3,
    )  # fmt: skip


class _KeepingPlant:
    """The car of a `lane-keeping-v0`, stepped by ticks; disturbances and torques do nothing."""

    def __init__(self, render_mode: str | None = None) -> None:
        rate = round(1.0 / TICK)
        self.env = LaneKeepingEnv({"simulation_frequency": rate, "policy_frequency": rate})
        self.env.render_mode = render_mode
        self.specific_force = (0.0, 0.0)

    def start(self, seed: int) -> None:
        """Begin an episode with a seed of highway-env's environment."""
        self.last_observation, _ = self.env.reset(seed=seed)
        self.s = 0.0
        self.project()

    def project(self) -> None:
        """Project the car onto highway-env's lane; the next tick is one of its own `step`."""
        self._is_full_step = True
        x, y, heading = self.env.vehicle.state[:3, 0].tolist()
        _, self.y, self.theta, self.curvature = locate_on_lane(self.env.lane, x, -y, -heading)

    def step(self, inputs: OutsideInputs, h: float) -> None:
        """Step the car over a tick of h seconds, and integrate its place on the lane.

        A control period's first tick is highway-env's own `step`; the others only move the car.
        """
        action = np.array([-inputs.steer / self.env.action_type.steering_range[1]])
        before = self.motion
        if self._is_full_step:
            self.last_observation, *_ = self.env.step(action)
        else:
            self.env.action_type.act(action)
            self.env.road.step(h)
        self._is_full_step, after = False, self.motion
        ends = zip(_compute_road_velocity(before), _compute_road_velocity(after), strict=True)
        distance, sideways = (0.5 * h * (a + b) for a, b in ends)
        ds = distance / (1.0 - self.curvature * self.y)
        self.s, self.theta = self.s + ds, self.theta + self.curvature * ds
        self.y += sideways
        rate = -float(self.env.vehicle.derivative[4, 0])
        self.specific_force = (-after.gamma * after.v_y, rate + after.gamma * after.v_x)

    @property
    def motion(self) -> Motion:
        """The car's state in our axes."""
        x, y, heading, speed, slide, turn = self.env.vehicle.state[:, 0].tolist()
        return Motion(speed, -slide, -turn, -heading, x, -y, self.s, self.y, self.theta)

    @property
    def is_finite(self) -> bool:
        """Whether the state is made of numbers."""
        return bool(np.isfinite(self.env.vehicle.state).all())

    def states(self, observation: Mapping[str, Array], preview: float) -> tuple[float, ...]:
        """Compute `STATES` of highway-env's observation, y_l at a preview distance (m)."""
        lateral, heading, slide, turn = np.ravel(observation["state"]).tolist()
        centre, lane = np.ravel(observation["reference_state"])[:2].tolist()
        psi, speed = math.remainder(lane - heading, 2.0 * math.pi), float(self.env.vehicle.speed)
        y_l = _compute_preview_offset(centre - lateral, psi, self.curvature, preview)
        return math.atan2(-slide, speed), -turn, psi, y_l


def _compute_road_velocity(motion: Motion) -> tuple[float, float]:
    """Compute the velocity (along, across) in the road's axes (m/s)."""
    angle = motion.psi - motion.theta
    cos, sin = math.cos(angle), math.sin(angle)
    return motion.v_x * cos - motion.v_y * sin, motion.v_x * sin + motion.v_y * cos


class KeepingEnv(PlantEnv):
    """`StabilityEnv` whose car and lane are those of highway-env's `lane-keeping-v0`.

    Action (its second entry steers, the first moves nothing), observation, record and cost are
    ours, so every estimator and `lane-keeping` run; `NativeObservation` has theirs. Needs the extra
    `highway`. A snapshot is refused: highway-env's environment makes none.

    Args:
        sensors: "vision", "vision-uneven", "gps" or "fusion".
        control_period: Ticks of 1 ms between two decisions; highway-env decides every 100.
        render_mode: Render mode of highway-env's environment.
        options: Further arguments of `StabilityEnv`.
    """

    def __init__(
        self,
        sensors: str = "vision",
        control_period: int = 10,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        self.plant: _KeepingPlant = _KeepingPlant(render_mode)
        options = {"steering": True, "reference": "zero-slip", **options}
        car = make_keeping_vehicle()
        super().__init__(sensors, KEEPING, car, control_period=control_period, **options)

    def _adapt_options(self, options: dict[str, Any]) -> dict[str, Any]:
        if options:
            raise ValueError(f"lane-keeping-v0 starts as it is, got {', '.join(options)}")
        self.plant.start(0)  # it always starts there
        return {"state": self.plant.motion._asdict()}

    def _start_episode(self) -> None:
        self.plant.start(int(self._row.z[Z.clock.key_low]))

    def _advance(self, command: npt.NDArray[np.float32]) -> int:
        """Drive a control period on the lane as it is here, which camera and record then have."""
        plant, z = self.plant, self._row.z
        plant.project()
        self._row.p[P.road.curvature] = plant.curvature
        z[Z.motion.y], z[Z.motion.theta] = plant.y, plant.theta
        return super()._advance(command)

    @property
    def truth(self) -> tuple[float, ...]:
        """The true `STATES`."""
        motion = self.motion
        psi = motion.psi - motion.theta
        y_l = _compute_preview_offset(motion.y, psi, self.plant.curvature, self.vehicle.preview)
        return math.atan2(motion.v_y, motion.v_x), motion.gamma, psi, y_l

    def get_state(self) -> dict[str, Any]:
        """Refuse: TypeError, since highway-env makes no snapshots."""
        raise TypeError("highway-env's lane-keeping-v0 makes no snapshots")

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        self.get_state()


class NativeObservation(gym.ObservationWrapper[Any, Any, Any]):
    """A `KeepingEnv` whose estimates are highway-env's own observation.

    Args:
        env: A `KeepingEnv`.
        returned: Whether it is the one that highway-env's `step` returns, from before the step;
            else the newest.
    """

    def __init__(self, env: gym.Env[Any, Any], returned: bool) -> None:
        super().__init__(env)
        self._returned = returned
        units = zip(STATES, ("rad", "rad/s", "rad", "m"), strict=True)
        entries = [ObservationEntry(f"{name}_hat", unit, -200.0, 200.0) for name, unit in units]
        self.layout = (*env.get_wrapper_attr("layout"), *entries)
        self.observation_space = make_space(self.layout)

    def observation(self, observation: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Append highway-env's `STATES` to an observation, in float32.

        Args:
            observation: That of the `KeepingEnv`.
        """
        base = self.env.unwrapped
        assert isinstance(base, KeepingEnv)
        plant = base.plant
        native = plant.last_observation if self._returned else plant.env.observation_type.observe()
        states = plant.states(native, base.vehicle.preview)
        return np.concatenate([observation, np.asarray(states, np.float32)])
