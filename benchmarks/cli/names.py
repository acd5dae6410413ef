"""Everything that has a name, with a line on each, and its completion in shells."""

import ast
import math
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym

from ...envs.validation import check_choice
from ..suites import SUITES

_ENVIRONMENTS = {
    "YawVision": "camera every 33 ms, 30 ms late",
    "YawVisionUneven": "camera every 33 ms, 10 to 30 ms late, time-stamped",
    "YawGps": "GPS (course, speed, position) every 200 ms",
    "YawFusion": "the uneven camera and the GPS",
    "AfsYawFusion": "the uneven camera and the GPS; the action steers too",
    "LinearYawVision": "camera, on a linear car whose best policy is known",
    "LinearYawGps": "GPS, on a linear car whose best policy is known",
    "Highway": "camera and GPS on highway-env's roads; a driver swerves around one that brakes",
    "Outside": "camera and GPS around CommonRoad's single-track, drift and multi-body models",
}


def _list_environments() -> dict[str, str]:
    ids = [name for name in gym.registry if name.startswith("sideslip/")]
    texts = {name: _ENVIRONMENTS[name.rpartition("/")[2].partition("-v")[0]] for name in ids}
    errs = "; car and sensors err"
    return {name: text + errs * name.endswith("-v1") for name, text in texts.items()}


def check_env(env_id: str) -> None:
    """Check that an id is registered, or MODULE:ID of one that registers it; ValueError otherwise.

    Args:
        env_id: Id of the env.
    """
    if env_id not in gym.registry and ":" not in env_id:
        check_choice("environment", env_id, _list_environments())


def _list_scenarios() -> dict[str, str]:
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
        particulars = {
            f"tier {scenario.tier}": scenario.tier,
            "side wind": any(scenario.range("wind_force")),
            "braking": scenario.speed_change < 0.0,
            "bend": any(scenario.range("curvature")),
            "another friction on the right": scenario.friction_right,
            "tyres that change": scenario.tyre_change_time,
            "outages": scenario.camera_outage or scenario.gps_outage,
            "starts sliding": any(scenario.range("initial_beta")),
        }
        words += [text for text, is_present in particulars.items() if is_present]
        lines[name] = ", ".join(words)
    return lines


def _format_range(ends: tuple[float, float], factor: float = 1.0) -> str:
    low, high = (f"{factor * end:.3g}" for end in ends)
    return low if low == high else f"{low} to {high}"


def _list_vehicles() -> dict[str, str]:
    from ...envs.vehicle.parameters import VEHICLES, critical_speed

    lines = {}
    for name, car in VEHICLES.items():
        limit = 3.6 * critical_speed(car)
        stable = "understeers" if limit == math.inf else f"unstable above {limit:.3g} km/h"
        lines[name] = f"{car.mass:g} kg, wheelbase {car.wheelbase:.2f} m, {stable}"
    return lines


def _list_estimators() -> dict[str, str]:
    from ...estimators.filters import FILTERS
    from ...estimators.make import ESTIMATORS

    behind = "a network behind the filter of its file, which corrects the sideslip angle"
    lines = {name: behind if name.startswith("learned") else "registered" for name in ESTIMATORS}
    for name, filter_ in FILTERS.items():
        slow = "camera, GPS or both" if len(filter_.slow) > 1 else "".join(filter_.slow)
        lines[name] = f"{slow.replace('gps', 'GPS') or 'fast sensors alone'}; {filter_.source}"
    return lines


def _list_agents() -> dict[str, str]:
    from ...agents import AGENTS

    return {name: _extract_sentence(AGENTS.load(name).__doc__) for name in AGENTS}


def _list_policies() -> dict[str, str]:
    from ...agents.learned.policy import list_shipped, load_policy

    lines = {}
    for name in list_shipped():
        card = load_policy(name).card
        lines[name] = f"{card.algorithm} on {card.world_id}, estimator {card.estimator or 'none'}"
    return lines


def _list_suites() -> dict[str, str]:
    """List the suites with the first sentence of their modules, which are not imported."""
    lines = {}
    for name, module in SUITES.items():
        spec = find_spec(module, __package__.rpartition(".")[0])
        assert spec is not None and spec.origin is not None
        module_text = Path(spec.origin).read_text(encoding="utf-8")
        lines[name] = _extract_sentence(ast.get_docstring(ast.parse(module_text)))
    return lines


def _extract_sentence(text: str | None) -> str:
    words = " ".join((text or "").split()).removeprefix("Question: ").replace("`", "")
    question, mark, _ = words.partition("? ")
    return question + "?" if mark else words.partition(". ")[0].removesuffix(".")


KINDS: dict[str, Callable[[], dict[str, str]]] = {
    "environments": _list_environments,
    "scenarios": _list_scenarios,
    "vehicles": _list_vehicles,
    "estimators": _list_estimators,
    "agents": _list_agents,
    "policies": _list_policies,
    "suites": _list_suites,
}  # functions that list the names of a kind with a line on each


def complete(*kinds: str) -> Callable[[str], Iterable[tuple[str, str]]]:
    """Make a shell completion of names.

    Args:
        kinds: Their kinds, of `KINDS`.

    Returns:
        Function from the beginning of a name to the names and a line on each.
    """

    def list_matches(incomplete: str) -> list[tuple[str, str]]:
        pairs = [pair for kind in kinds for pair in KINDS[kind]().items()]
        return [(name, line) for name, line in pairs if name.startswith(incomplete)]

    return list_matches
