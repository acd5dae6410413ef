"""Tasks of the control benchmark: a manoeuvre with its car, actuators and reference.

Those of a tier are chosen once, on tuning seeds, by the gap between the baselines
(`baseline_gaps.py`); `contests.json` holds them with the measured gaps. Test seeds follow a salt, a
hash of the contestants' sources and the env's version, so that nobody can have tuned on them.
"""

import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...agents import baselines
from ...envs.io import from_json
from ...envs.scenarios.manoeuvres import SCENARIOS, make_scenario
from ...envs.ticks import TICK
from ...envs.validation import check_choice
from ...envs.vehicle.parameters import VEHICLES
from ...estimators.learned.network import SUFFIX
from ..harness.results import read_objects

YAW = "sideslip/YawFusion-v0"
STEERING = "sideslip/AfsYawFusion-v0"
FILE = Path(__file__).with_name("contests.json")
COMMAND = "python -m sideslip.benchmarks.control.baseline_gaps --write"

NOMINAL, PARAMETERS, STATE = "nominal", "oracle-parameters", "oracle-state"
ORACLES = {PARAMETERS: baselines.PARAMETER_ORACLES, STATE: baselines.STATE_ORACLES}
"""The candidates for a baseline's name, of which a task has the better one."""

TIERS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "1": ((STEERING, "coms", "model"), (YAW, "coms", "zero-slip")),
    "2a": ((YAW, "passenger-car", "lagged"), (STEERING, "passenger-car", "lagged")),
    "2b": ((YAW, "passenger-car", "lagged"), (STEERING, "passenger-car", "lagged")),
    "2c": ((YAW, "passenger-car", "lagged"), (STEERING, "passenger-car", "lagged")),
}
"""The (env id, vehicle, reference) with which a tier's scenarios are driven."""
TITLES = {
    "1": "the COMS at 18 to 28 km/h",
    "2a": "the passenger car at 60 to 80 km/h on a dry road",
    "2b": "the passenger car on a road of unknown friction",
    "2c": "the passenger car at the limit of its tyres",
}
LIMIT = ("2c",)  # tiers in which nominal may fail as often as it does


@dataclass(frozen=True)
class ControlTask:
    """A scenario in an environment. Tasks are equal whatever the changes are."""

    tier: str = ""  # "" if unscored
    env_id: str = YAW
    vehicle: str = ""  # "" for the id's
    reference: str = ""  # "" for the id's
    scenario: str = "random-steering"
    # options of the env over its own, with a scenario that has no name
    changes: Mapping[str, Any] = field(default_factory=dict, compare=False, kw_only=True)

    @property
    def name(self) -> str:
        """Name in tables: the scenario and what acts."""
        return f"{self.scenario}, {'steering' if self.env_id == STEERING else 'yaw'}"

    @property
    def kind(self) -> str:
        """Class of the tasks that share their tuned options."""
        if self.vehicle in ("", "coms"):
            return f"coms-{'zero-slip' if self.reference == 'zero-slip' else 'model'}"
        return f"car-{'steering' if self.env_id == STEERING else 'yaw'}"

    @property
    def record(self) -> dict[str, str]:
        """What files hold of it. Its keys stay when a field gets another name."""
        names = ("tier", "env_id", "vehicle", "reference", "scenario")
        return {name: getattr(self, name) for name in names}

    @property
    def seed_text(self) -> str:
        """JSON from which the seeds are drawn."""
        return json.dumps(self.record)

    @property
    def control_period(self) -> float:
        """Time between two decisions (s)."""
        return int(self.changes.get("control_period", 10)) * TICK

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env without the changes."""
        car = {"vehicle": self.vehicle, "nominal": self.vehicle} if self.vehicle else {}
        reference_options = {"reference": self.reference} if self.reference else {}
        return {"scenario": self.scenario} | car | reference_options


def vary_scenario(task: ControlTask, change: Mapping[str, Any]) -> dict[str, Any]:
    """Make a task's scenario, over its name, with some fields changed.

    Noise comes to the scenario's own; "mass" is a factor on the true car's, of which controllers
    and filters know nothing.

    Args:
        task: Task whose scenario is varied.
        change: Fields of `Scenario`.

    Returns:
        Scenario as a mapping.
    """
    fields, base = dict(change), make_scenario(task.scenario)
    if "noise" in fields:
        fields["noise"] = dict(base.noise) | fields["noise"]
    if "mass" in fields:
        mass = fields.pop("mass") * VEHICLES[task.vehicle].mass
        fields["vehicle"] = dict(base.vehicle) | {"mass": mass}
    return {"base": task.scenario} | fields


@dataclass(frozen=True)
class TaskRecord:
    """The task of an entry of a file."""

    tier: str
    env_id: str
    vehicle: str
    reference: str
    scenario: str

    @property
    def task(self) -> ControlTask:
        """The task of these numbers."""
        return ControlTask(self.tier, self.env_id, self.vehicle, self.reference, self.scenario)


@dataclass(frozen=True)
class TaskMeasurement(TaskRecord):
    """A candidate with what was measured on tuning seeds: an entry of the file.

    oracle, knowing: The better of `ORACLES` for state and for parameters. gap: Mean of
    log(J_nominal / J_oracle) of the episodes that both survive, `judged` of n, with its 95 %
    interval. failing: Fraction in which nominal fails. verdict: "scored", or why not.
    """

    env_version: str
    oracle: str
    knowing: str
    gap: float
    low: float
    high: float
    failing: float
    judged: int
    n: int
    verdict: str


def list_candidates() -> list[ControlTask]:
    """List every scenario that has a tier, with each of the tier's ids and references."""
    return [
        ControlTask(tier, *variant, name)
        for tier, variants in TIERS.items()
        for variant in variants
        for name, scenario in SCENARIOS.items()
        if scenario.tier == tier
    ]


def read_tasks(path: Path = FILE) -> tuple[TaskMeasurement, ...]:
    """Read all candidates of a file.

    Args:
        path: File.

    Returns:
        Candidates.

    Raises:
        FileNotFoundError: There is no file.
        ValueError: It was measured with another version, is cut short, or names what there is not.
    """
    measurements = []
    for i, item in enumerate(read_objects(path), 1):
        where = f"{path}: entry {i}"
        measurement = from_json(TaskMeasurement, item, where)
        if measurement.env_version != __version__:
            raise ValueError(
                f"{where} was measured with version {measurement.env_version}, this is "
                f"{__version__}; measure the contests anew: {COMMAND}"
            )
        check_choice(f"{where}: oracle", measurement.oracle, ORACLES[STATE])
        check_choice(f"{where}: knowing", measurement.knowing, ORACLES[PARAMETERS])
        if measurement.task not in list_candidates():
            raise ValueError(
                f"{where}: {measurement.task} is no contest of this version; {COMMAND}"
            )
        measurements.append(measurement)
    return tuple(measurements)


@cache
def list_scored_tasks() -> tuple[ControlTask, ...]:
    """List the scored tasks, tier by tier; raises as `read_tasks`."""
    return tuple(entry.task for entry in read_tasks() if entry.verdict == "scored")


@cache
def _index_measurements() -> dict[ControlTask, TaskMeasurement]:
    return {measurement.task: measurement for measurement in read_tasks()} if FILE.is_file() else {}


def find_oracle(task: ControlTask, name: str = STATE) -> str:
    """Find the better of the candidates for an oracle in a task; LQR where none was measured.

    Args:
        task: Task of the candidates.
        name: Name of the oracle, in `ORACLES`.

    Returns:
        Name of the candidate.
    """
    measurement = _index_measurements().get(task)
    if measurement is None:
        return ORACLES[name][0]
    return measurement.oracle if name == STATE else measurement.knowing


Seeds = Sequence[int] | Callable[[ControlTask], Sequence[int]]  # of all tasks, or by task

_PACKAGE = Path(__file__).resolve().parents[2]
_CONTESTANTS = dict.fromkeys(("estimators", "agents"), (".py", ".toml", SUFFIX))
_LENGTH = 16
_TUNING = 2**29  # the clairvoyant's are beyond 2^30


def make_salt(*more: str) -> str:
    """Make the salt: a hash of the contestants' files, weights, the env's version and texts.

    Args:
        more: Texts that belong to it.

    Returns:
        Hexadecimal digits.
    """
    digest = hashlib.sha256(__version__.encode())
    for folder, endings in _CONTESTANTS.items():
        for path in sorted((_PACKAGE / folder).rglob("*")):
            if path.suffix in endings:
                digest.update(str(path.relative_to(_PACKAGE)).encode() + path.read_bytes())
    for text in more:
        digest.update(text.encode())
    return digest.hexdigest()[:_LENGTH]


def make_salted_seeds(salt: str, n: int, more: str = "") -> list[int]:
    """Make the first test seeds of a salt, below 2^32; more seeds keep the first.

    Args:
        salt: Hexadecimal digits.
        n: Number of seeds.
        more: Text that makes them others.

    Returns:
        Seeds.

    Raises:
        ValueError: The salt is not hexadecimal.
    """
    if not re.fullmatch("[0-9a-f]+", salt):
        raise ValueError(f"a salt is hexadecimal digits, got {salt!r}")
    words = [int(salt[i : i + 8], 16) for i in range(0, len(salt), 8)]
    words += list(hashlib.sha256(more.encode()).digest()) if more else []
    children = np.random.SeedSequence(words).spawn(n)
    return [int(child.generate_state(1)[0]) for child in children]


def make_task_seeds(salt: str, n: int) -> Callable[[ControlTask], list[int]]:
    """Make the function from a task to its first n test seeds.

    They differ between tasks: a seed draws the car as well, and tasks that share their cars would
    not be independent strata of an interval.

    Args:
        salt: Hexadecimal digits.
        n: Number of seeds.

    Returns:
        Function from a task to its seeds.
    """
    return lambda task: make_salted_seeds(salt, n, task.seed_text)


def make_tuning_seeds(n: int) -> list[int]:
    """Make the first seeds on which tasks are chosen and controllers tuned: no test's.

    Args:
        n: Number of seeds.

    Returns:
        Seeds.
    """
    return list(range(_TUNING, _TUNING + n))
