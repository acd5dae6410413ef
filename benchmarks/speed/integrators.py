"""Question: what does a rule of integration cost, and how far does it lead a car astray?

`python -m sideslip.benchmarks.speed.integrators --out table.md`
"""

import statistics
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from ...envs import SCENARIOS, StabilityEnv
from ...envs.backend.arrays import offsets, read, write
from ...envs.backend.decorators import jit
from ...envs.engine.layout import PARAMS_WIDTH, Z
from ...envs.engine.step import fixed_of, kind_of
from ...envs.engine.tick import Moving, changed, command, load_at
from ...envs.sensors.inertial import Chance
from ...envs.ticks import TICK
from ...envs.vehicle.actuators import lagged
from ...envs.vehicle.dynamics import Motion
from ...envs.vehicle.integration import kutta3, rk4
from ..harness.results import check_writable, write_text
from .plant import CARS, TICKS, Array, advance, cars_of
from .timing import QUICK, Contestant, interleaved

RULES = {"Kutta, three stages": 3, "classical, four stages": 4}
PARTS = 16  # steps a tick of the classical rule that the others are measured against
DRIVE = 5000  # ticks
MOTION = offsets(Motion)[0]
CALM = (0.0, 0.0, 0.0, 0.0)


@jit
def _load(s: Any, control: Any, drive: Any, fixed: Any, car: Any, kind: Any) -> Any:
    """The Load at a share s of a tick, actuators on their way."""
    motor, steering = fixed.motor, fixed.steering
    turned = lagged(control.steer, drive.delta_f, steering.start * steering.end**s)
    rest = motor.start * motor.end**s
    return load_at(turned, control.T_l, control.T_r, drive, rest, car, kind)


@jit
def _moved(p: Any, z: Any, switches: Any, share: float, motions: Any) -> None:
    """Move the motions of the three rules, (3, len(Motion)), through the tick that z begins."""
    fixed, kind = fixed_of(p), kind_of(p, switches)
    drive, lead, tick = read(z, Z.drive), read(z, Z.lead), z[Z.clock.tick]
    car = changed(fixed.car, fixed.change, tick >= fixed.change.tick)
    start = load_at(drive.delta_f, drive.T_l, drive.T_r, drive, 0.0, car, kind)
    for i in range(3):
        motion, parts = read(motions[i], MOTION), PARTS if i == 2 else 1
        refs = read(z, Z.refs)
        now = Moving(motion, drive, start, z[Z.driver], car, refs, lead)
        control = command(fixed, share * fixed.task.yaw_scale, 0.0, now, tick, Chance(CALM, CALM))
        for k in range(parts):
            loads = (
                _load(k / parts, control, drive, fixed, car, kind),
                _load((k + 0.5) / parts, control, drive, fixed, car, kind),
                _load((k + 1.0) / parts, control, drive, fixed, car, kind),
            )
            push, road, h, law = control.push, fixed.road, TICK / parts, kind.law
            if i == 0:
                motion = kutta3(motion, loads, push, car, road, h, kind.small_angle, law, kind.roll)
            else:
                motion = rk4(motion, loads, push, car, road, h, kind.small_angle, law, kind.roll)
        write(motions[i], motion, MOTION)


def errors_in(scenario: str, controlled: bool, ticks: int = DRIVE) -> Array:
    """The largest errors of a drive, (rules, 2): of a velocity in m/s, of the yaw rate in rad/s.

    The drive is the environment's, which ends where the car spins. Each rule moves a car of its own
    from the same start, whose driver holds its own speed under the same commands else.
    """
    env, rng = StabilityEnv(scenario=scenario, control_period=1), np.random.default_rng(0)
    env.reset(seed=0)
    motions = np.tile(np.array(env.motion), (3, 1))
    worst, action = np.zeros((2, 2)), np.zeros(1, np.float32)
    for tick in range(ticks):
        if controlled and tick % 10 == 0:
            action[:] = rng.uniform(-1.0, 1.0)
        snapshot = env._params[:PARAMS_WIDTH], env._state, env._switches
        _moved(*snapshot, float(action[0]), motions)
        off = np.abs(motions[:2] - motions[2])
        found = off[:, [MOTION.v_x, MOTION.v_y]].max(1), off[:, MOTION.gamma]
        worst = np.maximum(worst, np.stack(found, 1))
        if any(env.step(action)[2:4]):
            break
    return worst


def nanoseconds() -> list[float]:
    """CPU time of a tick of one car in lanes, by each rule."""
    cars = cars_of(CARS)

    def contestant(stages: int) -> Contestant:
        mine = cars.twin()
        return Contestant(lambda: advance(*mine, TICKS, stages), CARS * TICKS)

    taken = interleaved({name: contestant(rule) for name, rule in RULES.items()}, QUICK)
    return [1e3 * statistics.median(each) for each in taken.values()]


def table(names: list[str], ticks: int = DRIVE) -> str:
    """The table in Markdown, of drives through scenarios without control and with a random one."""
    errors = np.array([errors_in(name, each, ticks) for name in names for each in (False, True)])
    lines = [
        f"| {len(errors)} drives of {ticks * TICK:g} s | a tick, in lanes | median error "
        "| 90 % of the drives | largest |",
        "|---|---|---|---|---|",
    ]
    for rule, (name, cost) in enumerate(zip(RULES, nanoseconds(), strict=True)):
        found = np.quantile(errors[:, rule], [0.5, 0.9, 1.0], axis=0)
        cells = [f"{v:.0e} m/s, {gamma:.0e} rad/s" for v, gamma in found]
        lines.append(f"| {name} | {cost:.1f} ns | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path | None, typer.Option(help="Write the table as Markdown.")] = None,
) -> None:
    """Error against cost of the plant's rules over all scenarios, spinning cars included."""
    check_writable(out)
    text = table(list(SCENARIOS))
    Console().print(text, highlight=False, markup=False, soft_wrap=True)
    if out is not None:
        write_text(out, text)


if __name__ == "__main__":
    typer.run(main)
