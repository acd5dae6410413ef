"""Question: what do learned policies cost in a car whose equations are not ours?

CommonRoad's models of a BMW 320i take the place of the passenger car, on a straight road and by our
sensors and references. Controllers, filters and references are designed from that car, as far as
our `Vehicle` describes it; the policies, trained on another one, learn nothing of it.
"""

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ..agents.rollout import steps_of
from ..envs.outside.plants import OUTSIDE_PLANTS
from ..envs.scenarios.manoeuvres import scenario_from
from ..estimators.user_files import reason_of
from .control.build import make_cars
from .control.cells import ADAPTIVE, LEARNED, Cell
from .control.contests import NOMINAL, STEERING, Contest, changed, contests
from .control.episodes import NUMBERS, Chunk, Driven
from .control.run import measure
from .control.scores import gains, survived
from .control.seeds import salt_of, seeds_of_contests
from .harness.results import Suite, Table
from .harness.stats import Estimate, geometric_mean, share
from .harness.verdict import verdict
from .learned import EPISODES as EPISODES
from .learned import QUICK_EPISODES as QUICK_EPISODES
from .learned import Found, contestants, everybody, illustrated, tabled

NAME = "learned-outside"
OUTSIDE_ID = "sideslip/Outside-v0"
KINDS = tuple(kind for kind in LEARNED if kind.startswith("car-"))
"""Classes whose car is about as large and as fast as the BMW."""
MANOEUVRE = "any-friction-sine-with-dwell"
"""Which every class has, and after which a car heads as before: a straight road stays in sight."""
_RIVALS = (NOMINAL, ADAPTIVE["joint, friction"])
"""Over whose costs everybody's are: where there is no gap, there is no share."""
_TEXT = (
    "The passenger car's policies on CommonRoad's single-track, drift and multi-body models of a "
    "BMW 320i, beside controllers on the same late sensors that are designed for it. No training "
    "met it."
)
_NONE = " Left out: pip install 'sideslip[outside]'."


@dataclass(frozen=True)
class OutsideContest(Contest):
    """A class's contest with an outside plant in place of its car and a straight road in place of
    its bends. model: of `OutsideEnv`; like: the id whose actuators it has."""

    model: str = "drift"
    like: str = STEERING

    @property
    def kind(self) -> str:
        """The class whose tuned options everybody has."""
        return f"car-{'steering' if self.like == STEERING else 'yaw'}"

    @property
    def seed_text(self) -> str:
        """That of a contest, with the model and the id whose actuators it has."""
        return json.dumps(json.loads(super().seed_text) | {"model": self.model, "like": self.like})

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env; of the contest's cars only the friction that a designer expects."""
        friction = dict(scenario_from(self.scenario).nominal)["friction"]
        flat = {"road": "straight", "bank": 0.0, "vehicle": {}, "nominal": {"friction": friction}}
        return {
            "model": self.model,
            "scenario": changed(self, flat),
            "reference": self.reference,
            "steering": self.like == STEERING,
        }


def outside(kind: str, model: str) -> OutsideContest:
    """A class's `MANOEUVRE` with a model as the car."""
    like = next(each for each in contests() if (each.kind, each.scenario) == (kind, MANOEUVRE))
    return OutsideContest("", OUTSIDE_ID, "", like.reference, MANOEUVRE, model, like.env_id)


def drive(chunk: Chunk) -> Driven:
    """`control.episodes.drive` of cars that are stepped one by one: cost and failure of each
    episode, the other numbers NaN."""
    begun, numbers = time.process_time(), np.full((len(chunk.seeds), len(NUMBERS)), np.nan)
    try:
        env, agent = make_cars(chunk.cell, len(chunk.seeds))
        costs, failures = np.zeros((2, len(chunk.seeds)))
        for step in steps_of(env, agent, list(chunk.seeds)):
            costs -= np.where(step.running, step.reward, 0.0)
            failures = np.where(step.running, step.info["failure"], failures)
        env.close()
    except Exception as error:
        return Driven(numbers, np.nan, error=reason_of(error))
    numbers[:, NUMBERS.index("cost")] = costs
    numbers[:, NUMBERS.index("failure")] = failures
    return Driven(numbers, time.process_time() - begun)


def run(
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    quick: bool = False,
    salt: str = "",
) -> Suite:
    """Every class of `KINDS` on every model.

    episodes: of each. quick: the drift model alone. salt: of the seeds, "" for `salt_of`'s. The
    rest is of `control.run.measure`. Raises ValueError with the reason where somebody cannot drive.
    """
    suite = Suite(NAME, "Learned policies in cars that are not ours", _TEXT)
    if find_spec("vehiclemodels") is None:
        suite.text += _NONE
        return suite
    models = ["drift"] if quick else list(OUTSIDE_PLANTS)
    cells = [
        Cell(outside(kind, model), *who)
        for model in models
        for kind in KINDS
        for who in contestants(kind)
    ]
    salt = salt or salt_of()
    seeds = seeds_of_contests(salt, episodes)
    results = measure(cells, seeds, jobs=jobs, console=console, keep=keep, by=drive, title=NAME)
    found = [
        Found(
            kind, {each: [everybody(results, outside(kind, each), each)] for each in models}, salt
        )
        for kind in KINDS
    ]
    note = "Other seeds on each model. No training met any."
    for each in found:
        title = f"{each.kind} in a BMW"
        tabled(suite, each, title, OUTSIDE_ID, f"{MANOEUVRE} on a straight road", note)
        suite.tables.insert(-1, _ratios(each, title))
    suite.verdict = answer(found)
    illustrated(suite, found)
    return suite


def answer(found: Sequence[Found]) -> str:
    """The verdict: the policies of each class, by their cost over their rivals' on all models."""
    lines = []
    for each, policy in ((one, who) for one in found for _, who in LEARNED[one.kind]):
        costs = {rival: _over(each, policy, rival, each.driven) for rival in _RIVALS}
        said = ", ".join(f"{_percent(cost)} % of {rival}'s" for rival, cost in costs.items())
        fails = 100.0 * share(each.failed(policy)).value
        lines.append(f"{policy} costs {said}; {fails:.0f} % fail.")
    return verdict("On CommonRoad's BMW, designed for by all but the policies:", *lines)


def _over(found: Found, who: str, rival: str, models: Iterable[str]) -> Estimate:
    """Geometric mean of the cost over a rival's, paired, where the rival survives."""
    logs = []
    for (those,) in (found.driven[model] for model in models):
        kept = survived(those[rival])
        logs.append(-gains(those[rival].costs, those[who])[kept])
    return geometric_mean(*logs)


def _ratios(found: Found, title: str) -> Table:
    """What everybody costs on each model over `_RIVALS`."""
    cells = [
        [who, *("" if who == rival else _percent(_over(found, who, rival, [model]))
                for model in found.driven for rival in _RIVALS)]
        for _, who in contestants(found.kind)
    ]  # fmt: skip
    header = [f"{model}, % of {rival}" for model in found.driven for rival in _RIVALS]
    note = "Geometric means, paired, where the one compared with survives; a failure counts 20."
    return Table(f"{title}: cost over others'", ("controller", *header), cells, note)


def _percent(ratio: Estimate) -> str:
    return ratio.inline(100.0, ".0f")
