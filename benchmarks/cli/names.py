"""Names on the command line: a line on each for `sideslip list`, their completion in a shell."""

import ast
import math
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from ...envs.arguments import check_choice
from ..suites import SUITES

if TYPE_CHECKING:
    from ...envs.scenarios.scenario import Scenario

_ENVIRONMENTS = {
    "YawVision": "camera every 33 ms, 30 ms late",
    "YawVisionUneven": "camera every 33 ms, 10 to 30 ms late, time-stamped",
    "YawGps": "GPS (course, speed, position) every 200 ms",
    "YawFusion": "the uneven camera and the GPS",
    "AfsYawFusion": "the same; the action may steer too",
    "LinearYawVision": "the first on a linear car whose best policy is known",
    "LinearYawGps": "the same with the GPS",
    "Highway": "camera and GPS on highway-env's roads; a driver swerves around one that brakes",
    "Outside": "camera and GPS around CommonRoad's single-track, drift and multi-body models",
}


def environments() -> dict[str, str]:
    """The package's ids with their slow sensors."""
    import gymnasium as gym

    ids = [name for name in gym.registry if name.startswith("sideslip/")]
    return {name: _ENVIRONMENTS[name.rpartition("/")[2].partition("-v")[0]] for name in ids}


def check_env(env_id: str) -> None:
    """ValueError for an id that nobody registered; one with a colon imports its module first."""
    import gymnasium as gym

    if env_id not in gym.registry and ":" not in env_id:
        check_choice("environment", env_id, environments())


def scenarios() -> dict[str, str]:
    """What a driver does in each, how fast and on what; a range is drawn by the seed."""
    from ...envs.scenarios.manoeuvres import SCENARIOS

    found = {}
    for name, each in SCENARIOS.items():
        path = f" on {each.path}" if each.path != "road" else ""
        words = [
            f"{each.steering}{path}",
            f"{_range(each.range('speed'), 3.6)} km/h",
            f"friction {_range(each.range('friction'))}",
            f"{each.duration:g} s",
        ]
        words += [f"tier {each.tier}"] if each.tier else []
        found[name] = ", ".join([*words, *(text for text, there in _marks(each) if there)])
    return found


def _marks(each: "Scenario") -> list[tuple[str, Any]]:
    """What sets a scenario apart, and whether it does."""
    return [
        ("side wind", any(each.range("wind_force"))),
        ("braking", each.speed_change < 0.0),
        ("bend", any(each.range("curvature"))),
        ("another friction on the right", each.friction_right),
        ("tyres that change", each.tyre_change_time),
        ("outages", each.camera_outage or each.gps_outage),
        ("starts sliding", any(each.range("initial_beta"))),
    ]


def _range(ends: tuple[float, float], factor: float = 1.0) -> str:
    low, high = (f"{factor * end:.3g}" for end in ends)
    return low if low == high else f"{low} to {high}"


def vehicles() -> dict[str, str]:
    """Mass, wheelbase, and above which speed a car is unstable."""
    from ...envs.vehicle.vehicle import critical_speed
    from ...envs.vehicle.vehicles import VEHICLES

    found = {}
    for name, car in VEHICLES.items():
        limit = 3.6 * critical_speed(car)
        stable = "understeers" if limit == math.inf else f"unstable above {limit:.3g} km/h"
        found[name] = f"{car.mass:g} kg, wheelbase {car.wheelbase:.2f} m, {stable}"
    return found


def estimators() -> dict[str, str]:
    """The slow sensors that a filter takes, and where it comes from."""
    from ...estimators.filters import FILTERS
    from ...estimators.make import ESTIMATORS

    found = {name: "registered" for name in ESTIMATORS}
    behind = "a network behind the filter of its file, which corrects the sideslip angle"
    found |= {name: behind for name in found if name.startswith("learned")}
    for name, each in FILTERS.items():
        slow = " or ".join(each.slow) if len(each.slow) < 2 else "camera, GPS or both"
        found[name] = f"{slow.replace('gps', 'GPS') or 'fast sensors alone'}; {each.source}"
    return found


def agents() -> dict[str, str]:
    """The first sentence of each controller's docstring."""
    from ...agents import AGENTS

    return {name: _first_sentence(AGENTS.load(name).__doc__) for name in AGENTS}


def policies() -> dict[str, str]:
    """The algorithm and the environment of each policy that is shipped."""
    from ...agents.learned.files import load_policy, shipped

    cards = {name: load_policy(name).card for name in shipped()}
    return {
        name: f"{card.algorithm} on {card.env_id}, estimator {card.estimator or 'none'}"
        for name, card in cards.items()
    }


def suites() -> dict[str, str]:
    """The first sentence of each suite's module, which is not imported for it."""
    found = {}
    for name, (module, _) in SUITES.items():
        spec = find_spec(module, __package__.rpartition(".")[0])
        assert spec is not None and spec.origin is not None
        with open(spec.origin, encoding="utf-8") as file:
            found[name] = _first_sentence(ast.get_docstring(ast.parse(file.read())))
    return found


def _first_sentence(text: str | None) -> str:
    words = " ".join((text or "").split()).removeprefix("Question: ").replace("`", "")
    question, mark, _ = words.partition("? ")
    return question + "?" if mark else words.partition(". ")[0].removesuffix(".")


KINDS: dict[str, Callable[[], dict[str, str]]] = {
    "environments": environments,
    "scenarios": scenarios,
    "vehicles": vehicles,
    "estimators": estimators,
    "agents": agents,
    "policies": policies,
    "suites": suites,
}
"""What has a name, and a line on each."""


def complete(*kinds: str) -> Callable[[str], Iterable[Any]]:
    """A completion of names of these kinds, with the line on each."""

    def completed(incomplete: str) -> list[tuple[str, str]]:
        there = [pair for kind in kinds for pair in KINDS[kind]().items()]
        return [(name, line) for name, line in there if name.startswith(incomplete)]

    return completed
