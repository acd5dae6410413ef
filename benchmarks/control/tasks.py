"""Tasks of the control benchmark: a manoeuvre with its car, actuators and reference.

`contests.json` holds those that demand enough of a car without control (`calibration.py`). Test
seeds follow a salt, a hash of the entries' sources and the world: nobody can have tuned on them.

Args:
    n: Number of seeds.
    more: Texts that make salt or seeds others.
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

from ...agents import baselines
from ...agents.learned.network import SUFFIX
from ...envs.io import from_json
from ...envs.scenarios.manoeuvres import SCENARIOS, make_scenario
from ...envs.scenarios.world import WORLD_VERSION
from ...envs.validation import check_choice
from ..harness.results import read_objects

YAW = "sideslip/YawFusion-v0"
STEERING = "sideslip/AfsYawFusion-v0"
FILE = Path(__file__).with_name("contests.json")
COMMAND = "python -m sideslip.benchmarks.control.calibration --write"

NOMINAL, PARAMETERS, STATE = "nominal", "oracle-parameters", "oracle-state"
ORACLES = {PARAMETERS: baselines.PARAMETER_ORACLES, STATE: baselines.STATE_ORACLES}
"""The candidates for a baseline's name, of which a task has the better one."""

TIERS: dict[str, tuple[tuple[str, str, str], ...]] = {
    "small car": ((STEERING, "coms", "model"), (YAW, "coms", "zero-slip")),
    "road": ((YAW, "passenger-car", "lagged"), (STEERING, "passenger-car", "lagged")),
    "limit": ((YAW, "passenger-car", "lagged"), (STEERING, "passenger-car", "lagged")),
}  # the (env id, vehicle, reference) with which a tier's scenarios are driven
TITLES = {
    "small car": "the COMS at 18 to 28 km/h",
    "road": "the passenger car at 60 to 90 km/h, friction unknown",
    "limit": "the passenger car at 70 to 110 km/h, at the limit of its tyres",
}
LIMIT = "limit"  # the tier in which cars without control are lost
WORLD = "v1"  # of all tiers
LEAD_IN, QUICK_LEAD_IN = 20.0, 4.0  # s of gentle driving before a manoeuvre
COST_FLOOR, SLIP_COST_FLOOR = 0.0552, 0.0476
"""Cost (1/s) of a slip angle of 0.25 deg and a yaw rate 0.5 deg/s off, what instruments resolve;
the second where yaw rate is not judged."""


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
        named = {"vehicle": self.vehicle, "reference": self.reference}
        named |= {key: self.changes[key] for key in named if isinstance(self.changes.get(key), str)}
        if named["vehicle"] in ("", "coms"):
            return f"coms-{'zero-slip' if named['reference'] == 'zero-slip' else 'model'}"
        return f"car-{'steering' if self.env_id == STEERING else 'yaw'}"

    @property
    def record(self) -> dict[str, str]:
        """What files hold of it. Its keys stay when a field gets another name."""
        names = ("tier", "env_id", "vehicle", "reference", "scenario")
        return {name: getattr(self, name) for name in names}

    @property
    def world_id(self) -> str:
        """Id of the env in the tier's world."""
        return self.env_id.replace("-v0", f"-{WORLD}") if self.tier else self.env_id

    @property
    def seed_text(self) -> str:
        """JSON from which the seeds are drawn."""
        return json.dumps(self.record)

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env without the changes."""
        car = {"vehicle": self.vehicle, "nominal": self.vehicle} if self.vehicle else {}
        reference_options = {"reference": self.reference} if self.reference else {}
        world = {"world": WORLD, "lead_in": LEAD_IN} if self.tier else {}
        return {"scenario": self.scenario} | car | reference_options | world

    @property
    def cost_floor(self) -> float:
        """Cost J_0 of a drive whose errors are as small as instruments resolve."""
        scenario = make_scenario(self.changes.get("scenario", self.scenario))
        rate = SLIP_COST_FLOOR if self.reference == "zero-slip" else COST_FLOOR
        return rate * scenario.duration


@dataclass(frozen=True)
class TaskRecord:
    """The task of an entry of a file, and the world in which it was measured."""

    tier: str
    env_id: str
    vehicle: str
    reference: str
    scenario: str
    world_version: int

    @property
    def task(self) -> ControlTask:
        """The task of these numbers."""
        return ControlTask(self.tier, self.env_id, self.vehicle, self.reference, self.scenario)


@dataclass(frozen=True)
class TaskMeasurement(TaskRecord):
    """A candidate with what was measured on tuning seeds: an entry of the file."""

    oracle: str  # better of `ORACLES` for state
    knowing: str  # better of `ORACLES` for parameters
    peak_slip: float  # median peak of the slip angle without control (deg)
    lost: float  # fraction of the cars lost without control
    lost_nominal: float
    lost_oracle: float
    slip_gap: float  # median by which oracle-state's RMS error is below nominal's (deg)
    yaw_rate_gap: float  # the same of the yaw rate (deg/s)
    n: int
    verdict: str  # "scored", or why not


def list_candidates() -> list[ControlTask]:
    """List every scenario that has a tier, with each of the tier's ids and references."""
    return [
        ControlTask(tier, *variant, name)
        for tier, variants in TIERS.items()
        for variant in variants
        for name, scenario in SCENARIOS.items()
        if scenario.tier == tier
    ]


def _read_tasks(path: Path = FILE) -> tuple[TaskMeasurement, ...]:
    """Read all candidates of a file; ValueError for another world, or names that there are not."""
    measurements = []
    for i, item in enumerate(read_objects(path), 1):
        where = f"{path}: entry {i}"
        measurement = from_json(TaskMeasurement, item, where)
        if measurement.world_version != WORLD_VERSION:
            raise ValueError(
                f"{where} was measured in world {measurement.world_version}, this is "
                f"{WORLD_VERSION}; measure the tasks anew: {COMMAND}"
            )
        check_choice(f"{where}: oracle", measurement.oracle, ORACLES[STATE])
        check_choice(f"{where}: knowing", measurement.knowing, ORACLES[PARAMETERS])
        if measurement.task not in list_candidates():
            raise ValueError(f"{where}: {measurement.task} is no task of this version; {COMMAND}")
        measurements.append(measurement)
    return tuple(measurements)


@cache
def list_scored_tasks() -> tuple[ControlTask, ...]:
    """List the scored tasks, tier by tier; raises as `_read_tasks`."""
    return tuple(entry.task for entry in _read_tasks() if entry.verdict == "scored")


@cache
def _index_measurements() -> dict[ControlTask, TaskMeasurement]:
    return {item.task: item for item in _read_tasks()} if FILE.is_file() else {}


def find_oracle(task: ControlTask, name: str = STATE) -> str:
    """Find the better of the candidates for an oracle in a task; LQR where none was measured.

    Args:
        task: Task of the candidates.
        name: Name of the oracle, in `ORACLES`.
    """
    measurement = _index_measurements().get(task)
    if measurement is None:
        return ORACLES[name][0]
    return measurement.oracle if name == STATE else measurement.knowing


Seeds = Sequence[int] | Callable[[ControlTask], Sequence[int]]  # of all tasks, or by task

_PACKAGE = Path(__file__).resolve().parents[2]
_ENTRY_SOURCES = dict.fromkeys(("estimators", "agents"), (".py", ".toml", SUFFIX))
_TUNING = 2**29  # the clairvoyant's are beyond 2^30


def make_salt(*more: str) -> str:
    """Make the salt: a hash of entries' files, their weights, the world's version and texts."""
    digest = hashlib.sha256(str(WORLD_VERSION).encode())
    for folder, endings in _ENTRY_SOURCES.items():
        for path in sorted((_PACKAGE / folder).rglob("*")):
            if path.suffix in endings:
                digest.update(str(path.relative_to(_PACKAGE)).encode() + path.read_bytes())
    digest.update("".join(more).encode())
    return digest.hexdigest()[:16]


def make_salted_seeds(salt: str, n: int, more: str = "") -> list[int]:
    """Make the first test seeds of a salt, below 2^32; more seeds keep the first."""
    if not re.fullmatch("[0-9a-f]+", salt):
        raise ValueError(f"a salt is hexadecimal digits, got {salt!r}")
    words = [int(salt[i : i + 8], 16) for i in range(0, len(salt), 8)]
    words += list(hashlib.sha256(more.encode()).digest()) if more else []
    children = np.random.SeedSequence(words).spawn(n)
    return [int(child.generate_state(1)[0]) for child in children]


def make_task_seeds(salt: str, n: int) -> Callable[[ControlTask], list[int]]:
    """Make the function from a task to its first n test seeds.

    They differ: tasks that share their cars would not be independent strata of an interval.
    """
    return lambda task: make_salted_seeds(salt, n, task.seed_text)


def make_tuning_seeds(n: int) -> list[int]:
    """Make the first seeds on which tasks are chosen and controllers tuned: no test's."""
    return list(range(_TUNING, _TUNING + n))
