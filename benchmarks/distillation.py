"""What `sideslip distill` learns from, the contests of a class with their teacher, what goes on
from it, and what came of it in each of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from ..agents.learned.card import Card, JsonMap
from ..agents.learned.files import Policy, is_policy, load_policy, save_policy
from ..envs.arguments import check_choice
from ..envs.scenarios.manoeuvres import scenario_from
from ..envs.task.observation import SEEN
from ..estimators.vector.estimate import EstimateObservation
from .control.build import estimate_options, make_cars
from .control.cells import ADAPTIVE, REFERENCE_FILTER, RUNGS, Cell
from .control.contests import NOMINAL, ORACLES, PARAMETERS, Contest, changed, contests
from .control.episodes import Chunk, drive
from .control.scores import gains
from .control.seeds import salted_seeds
from .harness.parallel import run_cases
from .harness.stats import Estimate, geometric_mean, won
from .policies import enjoy, evaluation

if TYPE_CHECKING:
    from ..agents.training.distill import Lesson
    from ..agents.training.task import Task

JOINT, RIVAL = "joint, friction", "adaptive-nmpc"
OUTPUTS = ("beta", "gamma", "phi", "phi_rate", "F_d", "N_d", "bias", "front_tyres", "rear_tyres",
           "inverse_friction")  # fmt: skip
"""What a student on `joint` reads of it, with standard deviations."""
VARIED = {
    "tyres": (0.4, 2.0),
    "wind": (-500.0, 500.0),
    "mass": (0.8, 1.3),
    "camera": (0.01, 0.12),
    "out": (2.0, 6.0),
}
"""Of lessons that are varied: factors on each axle's tyres and the wind's force from the side, in
N, in every episode, and, of a lesson, on the true car's mass; how late its camera is, and how long
its GPS or its camera is out, in s."""
_ALONE = (*RUNGS, *(name for names in ORACLES.values() for name in names))
FILTERS = ("", "joint")


def contests_of(kind: str) -> list[Contest]:
    """The scored contests of a class; ValueError for an unknown one."""
    check_choice("class of contests", kind, list(dict.fromkeys(each.kind for each in contests())))
    return [each for each in contests() if each.kind == kind]


def card_of(
    kind: str,
    estimator: str = "",
    teacher: str = RIVAL,
    seen: Mapping[str, Any] | None = None,
    **rest: Any,
) -> Card:
    """The card of a policy for a class of contests, in the first one's env with options `seen` of
    what is observed; rest: other fields."""
    check_choice("estimator", estimator, FILTERS)
    for name in seen or {}:
        check_choice("option", name, SEEN)
    first = contests_of(kind)[0]
    options = _options(first, teacher) if estimator else {}
    return Card.of(first.env_id, first.env_options | dict(seen or {}), estimator, options, **rest)


def _options(contest: Contest, teacher: str) -> JsonMap:
    """The filter of a teacher that reads `joint`, else of the rival, which is the same in all
    contests of a class, and more of its states."""
    filters = {who: name for name, who in ADAPTIVE.items()}
    who = teacher if teacher in filters else RIVAL
    own = estimate_options(Cell(contest, filters[who], who))["options"]
    known = [each for each in OUTPUTS if each != "inverse_friction" or f"{each}_sd" in own]
    return {"outputs": known, "std": True, "options": own}


def _changes(varied: int, rng: np.random.Generator) -> Iterator[JsonMap]:
    """What lessons change of their contest's scenario: nothing, then `VARIED` so many times."""
    yield {}
    for _ in range(varied):
        begins, lasts = rng.uniform(0.0, 4.0), rng.uniform(*VARIED["out"])
        yield {
            "front_stiffness": VARIED["tyres"],
            "rear_stiffness": VARIED["tyres"],
            "camera_delays": [round(rng.uniform(*VARIED["camera"]), 3)],  # whole ticks
            f"{rng.choice(('gps', 'camera'))}_outage": (begins, begins + lasts),
            "wind_force": VARIED["wind"],
            "wind_start": (0.0, 4.0),
            "wind_length": (1.0, 4.0),
            "mass": float(rng.uniform(*VARIED["mass"])),
        }


def lessons_of(
    kind: str,
    teacher: str,
    estimator: str,
    cars: int,
    varied: int = 0,
    seed: int = 0,
    seen: Mapping[str, Any] | None = None,
) -> "list[Lesson]":
    """A lesson for each contest of a class, and more of each where what the contest keeps varies.

    teacher: a rung, a controller of the matrix, which reads its filter there, or a policy, which
    reads the one of its card. cars: of each contest's lesson. varied: so many more, as `VARIED`
    says, share as many cars, rounded up; no filter and no teacher learns of it. seed: of what is
    drawn for them. seen: options of what the student observes. Raises ValueError for another name,
    or where that observation lacks what the teacher needs.
    """
    from ..agents.training.distill import Lesson

    rng = np.random.default_rng(seed)
    reads = {who: name for name, who in ADAPTIVE.items()} | dict.fromkeys(_ALONE, "")
    if is_policy(teacher):
        reads[teacher] = load_policy(teacher).card.estimator
    found = []
    for contest in contests_of(kind):
        for change in _changes(varied, rng):
            own = {"scenario": changed(contest, change)} if change else {}
            cell = Cell(contest, reads.get(teacher, REFERENCE_FILTER), teacher, own)
            count = -(-cars // varied) if change else cars
            twins, agent = make_cars(cell, count)
            options = contest.env_options | own | dict(seen or {})
            env: Any = gym.make_vec(contest.env_id, num_envs=count, **options)
            if estimator:
                env = EstimateObservation(env, estimator, **_options(contest, teacher))
            found.append(Lesson(env, twins, agent))
    return found


def start_and_task(
    agent: Path | None, varied: int = 0
) -> "tuple[Path | Policy | None, Callable[..., Task]]":
    """What `sideslip train -i` begins with, and what makes its task of the fields that were said.

    agent: a zip's path stays what it is; a distilled policy goes on in all contests of its class,
    but for those with a driver where cars are driven on tensors: rows are of one kind there.
    varied: so many times in each of them as `VARIED` says, too, drawn by the training's seed and
    not as `lessons_of` draws. Raises ValueError for them without contests of a class.
    """
    from ..agents.training.algorithms import algorithm_of
    from ..agents.training.starts import task_from
    from ..agents.training.task import Task

    policy = load_policy(agent) if agent is not None and is_policy(str(agent)) else None
    kind = policy.card.algorithm_options.get("class") if policy else None
    if varied and kind is None:
        raise ValueError(f"--varied is for a policy of a class of contests, got {agent}")
    if policy is None:
        return agent, Task

    def going_on(**fields: Any) -> Task:
        said = "scenarios" in fields or "scenario" in fields.get("env_options", {})
        if said and varied:
            raise ValueError("--varied is of a policy's own contests: without other scenarios")
        if kind is not None and not said:
            mine, rng = contests_of(kind), np.random.default_rng([fields.get("seed", 0), 1])
            if algorithm_of(fields.get("algo", "ppo")).on_tensors:
                mine = [c for c in mine if scenario_from(c.scenario).steering != "driver"]
            fields["scenarios"] = [
                changed(contest, change) if change else contest.scenario
                for contest in mine
                for change in _changes(varied, rng)
            ]
        return task_from(policy, **fields)

    return policy, going_on


def judge(path: Path, kind: str, episodes: int) -> JsonMap:
    """Drive a policy, `nominal`, the rival and oracle-parameters on seeds made from its weights,
    and write into its card what it costs; what is written."""
    policy, found = load_policy(path), enjoy(str(path), episodes)
    those = contests_of(kind)
    driven = run_cases(partial(_judged, path, episodes=episodes), those, "contests", jobs=1)
    costs = dict(zip((each.scenario for each in those), driven, strict=True))
    own = evaluation(found) | {"cost in % of nominal": costs}
    save_policy(path, policy.network, replace(policy.card, evaluation=own))
    return own


def _judged(path: Path, contest: Contest, episodes: int) -> JsonMap:
    policy = load_policy(path)
    seeds = tuple(salted_seeds(policy.salt, episodes, contest.seed_text))
    cells = {
        "policy": Cell(contest, policy.card.estimator, str(path)),
        NOMINAL: Cell(contest, "", NOMINAL),
        RIVAL: Cell(contest, JOINT, RIVAL),
        PARAMETERS: Cell(contest, "", PARAMETERS),
    }
    driven = {name: drive(Chunk(cell, seeds)) for name, cell in cells.items()}
    for name, each in driven.items():
        if each.error:
            raise ValueError(f"{name} cannot drive {contest.name}: {each.error}")
    costs = driven[NOMINAL].costs
    shown: JsonMap = {
        name: _rounded(geometric_mean(-gains(costs, each)), 100.0)
        for name, each in driven.items()
        if name != NOMINAL
    }
    beaten = {name: won(driven["policy"].costs, driven[name].costs) for name in (NOMINAL, RIVAL)}
    fails = float((driven["policy"]["failure"] != 0.0).mean())
    better = {f"better than {name}": _rounded(each, 1.0) for name, each in beaten.items()}
    return shown | better | {"fails": fails}


def _rounded(numbers: Estimate, unit: float) -> Sequence[float]:
    return [round(unit * each, 3) for each in numbers]
