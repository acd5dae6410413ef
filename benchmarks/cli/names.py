"""Names on the command line: a line on each for `sideslip list`, their completion in a shell."""

import ast
import math
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from ...envs.validation import check_choice
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


def list_environments() -> dict[str, str]:
    """The package's ids with their slow sensors."""
    import gymnasium as gym

    ids = [name for name in gym.registry if name.startswith("sideslip/")]
    return {name: _ENVIRONMENTS[name.rpartition("/")[2].partition("-v")[0]] for name in ids}


def check_env(env_id: str) -> None:
    """ValueError for an id that nobody registered; one with a colon imports its module first."""
    import gymnasium as gym

    if env_id not in gym.registry and ":" not in env_id:
        check_choice("environment", env_id, list_environments())


def list_scenarios() -> dict[str, str]:
    """What a driver does in each, how fast and on what; a range is drawn by the seed."""
    from ...envs.scenarios.manoeuvres import SCENARIOS

    lines = {}
    for name, scenario in SCENARIOS.items():
        path = f" on {scenario.path}" if scenario.path != "road" else ""
        words = [
            f"{scenario.steering}{path}",
            f"{_format_range(scenario.range('speed'), 3.6)} km/h",
            f"friction {_format_range(scenario.range('friction'))}",
            f"{scenario.duration:g} s",
        ]
        words += [f"tier {scenario.tier}"] if scenario.tier else []
        lines[name] = ", ".join(
            [*words, *(text for text, is_set in _list_marks(scenario) if is_set)]
        )
    return lines


def _list_marks(scenario: "Scenario") -> list[tuple[str, Any]]:
    """What sets a scenario apart, and whether it does."""
    return [
        ("side wind", any(scenario.range("wind_force"))),
        ("braking", scenario.speed_change < 0.0),
        ("bend", any(scenario.range("curvature"))),
        ("another friction on the right", scenario.friction_right),
        ("tyres that change", scenario.tyre_change_time),
        ("outages", scenario.camera_outage or scenario.gps_outage),
        ("starts sliding", any(scenario.range("initial_beta"))),
    ]


def _format_range(ends: tuple[float, float], factor: float = 1.0) -> str:
    low, high = (f"{factor * end:.3g}" for end in ends)
    return low if low == high else f"{low} to {high}"


def list_vehicles() -> dict[str, str]:
    """Mass, wheelbase, and above which speed a car is unstable."""
    from ...envs.vehicle.parameters import VEHICLES, critical_speed

    lines = {}
    for name, car in VEHICLES.items():
        limit = 3.6 * critical_speed(car)
        stable = "understeers" if limit == math.inf else f"unstable above {limit:.3g} km/h"
        lines[name] = f"{car.mass:g} kg, wheelbase {car.wheelbase:.2f} m, {stable}"
    return lines


def list_estimators() -> dict[str, str]:
    """The slow sensors that a filter takes, and where it comes from."""
    from ...estimators.filters import FILTERS
    from ...estimators.make import ESTIMATORS

    lines = {name: "registered" for name in ESTIMATORS}
    behind = "a network behind the filter of its file, which corrects the sideslip angle"
    lines |= {name: behind for name in lines if name.startswith("learned")}
    for name, filter_ in FILTERS.items():
        slow = " or ".join(filter_.slow) if len(filter_.slow) < 2 else "camera, GPS or both"
        lines[name] = f"{slow.replace('gps', 'GPS') or 'fast sensors alone'}; {filter_.source}"
    return lines


def list_agents() -> dict[str, str]:
    """The first sentence of each controller's docstring."""
    from ...agents import AGENTS

    return {name: _extract_sentence(AGENTS.load(name).__doc__) for name in AGENTS}


def list_policies() -> dict[str, str]:
    """The algorithm and the environment of each policy that is shipped."""
    from ...agents.learned.policy import list_shipped, load_policy

    cards = {name: load_policy(name).card for name in list_shipped()}
    return {
        name: f"{card.algorithm} on {card.env_id}, estimator {card.estimator or 'none'}"
        for name, card in cards.items()
    }


def list_suites() -> dict[str, str]:
    """The first sentence of each suite's module, which is not imported for it."""
    lines = {}
    for name, (module, _) in SUITES.items():
        spec = find_spec(module, __package__.rpartition(".")[0])
        assert spec is not None and spec.origin is not None
        with open(spec.origin, encoding="utf-8") as file:
            lines[name] = _extract_sentence(ast.get_docstring(ast.parse(file.read())))
    return lines


def _extract_sentence(text: str | None) -> str:
    words = " ".join((text or "").split()).removeprefix("Question: ").replace("`", "")
    question, mark, _ = words.partition("? ")
    return question + "?" if mark else words.partition(". ")[0].removesuffix(".")


KINDS: dict[str, Callable[[], dict[str, str]]] = {
    "environments": list_environments,
    "scenarios": list_scenarios,
    "vehicles": list_vehicles,
    "estimators": list_estimators,
    "agents": list_agents,
    "policies": list_policies,
    "suites": list_suites,
}
"""What has a name, and a line on each."""


def complete(*kinds: str) -> Callable[[str], Iterable[Any]]:
    """A completion of names of these kinds, with the line on each."""

    def list_matches(incomplete: str) -> list[tuple[str, str]]:
        pairs = [pair for kind in kinds for pair in KINDS[kind]().items()]
        return [(name, line) for name, line in pairs if name.startswith(incomplete)]

    return list_matches
