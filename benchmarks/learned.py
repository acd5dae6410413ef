"""Question: what do learned policies cost in conditions that no contest has, against all rivals?

Each shipped policy of `LEARNED` drives contests of its class on salted seeds, beside controllers on
the same late sensors and the rungs of the ladder. Nobody learns of a condition: filters have the
levels of the contest itself. Trainings varied some of the conditions, a few of them two more; the
others nobody ever met.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from .. import __version__
from ..agents.rollout import cost_ratios
from ..envs.record import Array
from .control.cells import ADAPTIVE, CONTROLLERS, LEARNED, REFERENCE_FILTER, Cell
from .control.contests import NOMINAL, PARAMETERS, Contest, changed, contests
from .control.episodes import Driven
from .control.run import Results, measure
from .control.scores import FAILED, Yardstick, score
from .control.seeds import salt_of, seeds_of_contests
from .harness.results import Row, Suite, Table
from .harness.stats import Estimate, geometric_mean, profile, share, won, worst
from .harness.verdict import verdict

NAME, TRAINED = "learned", "as trained"
EPISODES, QUICK_EPISODES = 32, 4
PAPERS = ("two-dof", "model-following")
RIVALS = tuple(ADAPTIVE.values())
"""Against whom episodes are counted, beside nominal and the papers'."""
LEAST = 0.1  # mean log ratio between nominal and oracle-parameters, of which there are shares
_LEVELS = np.geomspace(0.1, 10.0, 41)
_TEXT = (
    "The shipped policies beside controllers on the same late sensors, on salted seeds and in "
    "conditions that no contest has, in three contests of a policy's class. Share: of the "
    "paired log ratio of cost from nominal (0) to oracle-parameters (1), which knows car, friction "
    "and biases, over the contests, on the episodes that both survive; a failure counts as 20 "
    "times nominal's cost."
)


def _tyres(low: float, high: float) -> dict[str, Any]:
    return dict.fromkeys(("front_stiffness", "rear_stiffness"), (low, high))


CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    TRAINED: {},
    "tyres 0.45 to 0.6": _tyres(0.45, 0.6),
    "tyres 1.4 to 1.8": _tyres(1.4, 1.8),
    "camera 100 ms late": {"camera_delays": [0.1], "camera_jitter": 0.0},
    "no GPS from 2 to 7 s": {"gps_outage": (2.0, 7.0)},
    "gyro 0.5 deg/s off": {"noise": {"gyro_bias": float(np.radians(0.5))}},
    "a quarter heavier": {"mass": 1.25},
    "no camera from 2 to 7 s": {"camera_outage": (2.0, 7.0)},
    "400 N from the side": {"wind_force": 400.0, "wind_start": 2.0, "wind_length": 3.0},
    "half the pictures lost": {"camera_loss": 0.5},
}
"""What each one changes of a contest's scenario, as `contests.changed` takes it."""
NEVER_MET = ("gyro 0.5 deg/s off", "half the pictures lost")
"""Those that no training varied (`distillation.VARIED` has the others)."""
LATELY_MET = ("no camera from 2 to 7 s", "400 N from the side")
"""Those that the trainings of `raw-coms-steering` and `raw-coms-yaw` varied, and no older one."""
QUICK_CONDITIONS = (TRAINED, "tyres 1.4 to 1.8", "no GPS from 2 to 7 s", "400 N from the side")


def scenario_in(contest: Contest, condition: str) -> dict[str, Any]:
    """A contest's scenario in a condition, over its name."""
    return changed(contest, CONDITIONS[condition])


def contestants(kind: str) -> list[tuple[str, str]]:
    """(estimator, controller) of everybody who drives a class: rungs, classics, policies."""
    classics = [who for who in PAPERS if who in CONTROLLERS[chosen(kind)[0].env_id]]
    return [
        ("", NOMINAL),
        ("", PARAMETERS),
        *((REFERENCE_FILTER, who) for who in classics),
        *ADAPTIVE.items(),
        *LEARNED[kind],
    ]


def chosen(kind: str) -> list[Contest]:
    """Contests of a class: the one in the middle of each of its three tiers, or three of its only
    tier, evenly apart."""
    mine = [each for each in contests() if each.kind == kind]
    tiers = [[c for c in mine if c.tier == tier] for tier in dict.fromkeys(c.tier for c in mine)]
    each = max(3 // len(tiers), 1)
    return [those[(2 * i + 1) * len(those) // (2 * each)] for those in tiers for i in range(each)]


@dataclass
class Found:
    """A class's episodes: of each condition, of each contest in the order of `chosen`. salt: of
    their seeds."""

    kind: str
    driven: dict[str, list[dict[str, Driven]]] = field(default_factory=dict)
    salt: str = ""

    def shared(self, name: str, condition: str) -> Estimate:
        """A contestant's share of the gap in a condition; NaN of one below `LEAST`."""
        there = self.driven[condition]
        yards = [Yardstick(each[NOMINAL], each[PARAMETERS]) for each in there]
        gaps = [yard.gap for yard in yards if not np.isnan(yard.gap)]  # NaN: nobody survived
        if not gaps or not np.mean(gaps) > LEAST:
            return Estimate(np.nan)
        return score([yard.paired(each[name]) for yard, each in zip(yards, there, strict=True)])

    def ratios(self, name: str) -> Array:
        """Cost over nominal's, of each episode in all conditions and contests; infinite where it
        ended by a failure."""
        ratios = cost_ratios(self.costs(name), self.costs(NOMINAL))
        return np.where(self.failed(name), np.inf, ratios)

    def costs(self, name: str) -> Array:
        """A contestant's in all conditions and contests, one behind the other."""
        return np.concatenate([each[name].costs for each in self._all()])

    def failed(self, name: str) -> Array:
        """Which of those episodes ended by a failure."""
        return np.concatenate([each[name]["failure"] != 0.0 for each in self._all()])

    def _all(self) -> list[dict[str, Driven]]:
        return [each for those in self.driven.values() for each in those]


def run(
    episodes: int = EPISODES,
    jobs: int | None = None,
    console: Console | None = None,
    keep: Path | None = None,
    quick: bool = False,
    salt: str = "",
) -> Suite:
    """Every class that has a policy, in every condition.

    episodes: of each contest and condition. quick: in a few conditions. salt: of the seeds, ""
    for `salt_of`'s. The rest is of `control.run.measure`. Raises ValueError with the reason where
    somebody cannot drive.
    """
    suite = Suite(NAME, "Learned policies where contests never are", _TEXT)
    salt = salt or salt_of()
    seeds, results = seeds_of_contests(salt, episodes), dict[str, Results]()
    everyone = [contest for kind in LEARNED for contest in chosen(kind)]
    for condition in QUICK_CONDITIONS if quick else CONDITIONS:
        cells = [
            Cell(contest, *who, {"scenario": scenario_in(contest, condition)})
            for contest in everyone
            for who in contestants(contest.kind)
        ]
        results[condition] = measure(
            cells, seeds, jobs=jobs, console=console, keep=keep, title=f"{NAME}, {condition}"
        )
    found = [
        Found(
            kind,
            {
                condition: [everybody(those, contest, condition) for contest in chosen(kind)]
                for condition, those in results.items()
            },
            salt,
        )
        for kind in LEARNED
    ]
    for each in found:
        driven = ", ".join(contest.scenario for contest in chosen(each.kind))
        note = f"No training met: {'; '.join(NEVER_MET)}. "
        note += f"Only those of the COMS's policies without a filter met: {'; '.join(LATELY_MET)}."
        tabled(suite, each, each.kind, chosen(each.kind)[0].env_id, driven, note)
    suite.verdict = answer(found)
    illustrated(suite, found)
    return suite


def everybody(results: Results, contest: Contest, condition: str) -> dict[str, Driven]:
    """The episodes of all who drive a contest; ValueError with the reason where somebody cannot."""
    mine = {
        who: results.of(contest, who, estimator) for estimator, who in contestants(contest.kind)
    }
    wrong = [f"{who}, {condition}: {each.error}" for who, each in mine.items() if each.error]
    if wrong:
        raise ValueError("; ".join(wrong))
    return mine


def answer(found: Sequence[Found]) -> str:
    """The verdict: each policy's share of the gap, as trained and in the worst condition."""
    lines = []
    for each in found:
        _, policy = LEARNED[each.kind][0]
        shares = {name: each.shared(policy, name).value for name in each.driven}
        unmet = NEVER_MET + LATELY_MET  # by it, the class's first
        met = [share for name, share in shares.items() if name not in (TRAINED, *unmet)]
        new = [share for name, share in shares.items() if name in unmet]
        better = won(each.costs(policy), each.costs(RIVALS[0])).value
        lines.append(
            f"{policy} closes {shares[TRAINED]:.2f} of the gap; at worst {_least(met)} where it "
            f"trained, {_least(new)} where never; beats {RIVALS[0]} in {100.0 * better:.0f} %."
        )
    return verdict(*lines)


def _least(shares: Sequence[float]) -> str:
    """The least of those that are, "-" where none is."""
    return f"{min(there):.2f}" if (there := [each for each in shares if each == each]) else "-"


def tabled(suite: Suite, found: Found, title: str, env_id: str, driven: str, more: str) -> None:
    """A class's rows and tables; driven: what was, more: to be said of it in the note."""
    names = [who for _, who in contestants(found.kind)]
    episodes = len(found.costs(NOMINAL))
    rivals = [who for who in (NOMINAL, *PAPERS, *RIVALS) if who in names]
    shares, all_in_all = [], []
    for who in names:
        mine = {condition: found.shared(who, condition) for condition in found.driven}
        shares.append([who, *map(_shown, mine.values())])
        costs = found.costs(who)
        ratio = worst(cost_ratios(costs, found.costs(NOMINAL))).value
        beaten = [
            "" if who == rival else f"{100.0 * won(costs, found.costs(rival)).value:.0f} %"
            for rival in rivals
        ]
        fails = share(found.failed(who)).value
        all_in_all.append([who, *beaten, f"{100.0 * fails:.1f} %", f"{ratio:.2f}"])
        who_and_how = {"controller": who, "n": episodes, "salt": found.salt}
        for condition, each in mine.items():
            if not np.isfinite(each.value):
                continue  # there is no gap
            where = {"suite": suite.name, "scenario": f"{found.kind}, {condition}"}
            version = {"env_version": f"{env_id} {__version__}"}
            suite.rows.append(Row.of("score", each, **where, **who_and_how, **version))
    count = episodes // len(found.driven)
    note = f"{driven}; {count} episodes a condition, the same for everybody. {more}"
    if any("-" in row for row in shares):
        note += f" -: nominal's mean log ratio to {PARAMETERS} is below {LEAST}."
    suite.tables += [
        Table(f"{title}: share of the gap", ("controller", *found.driven), shares, note),
        Table(
            f"{title}: all conditions together",
            ("controller", *(f"beats {each}" for each in rivals), "fails", "worst 5 %"),
            all_in_all,
            f"Of {episodes} episodes. worst 5 %: mean of the largest ratios to nominal's cost.",
        ),
    ]


def _shown(share: Estimate) -> str:
    """A share, or "-" where there is no gap."""
    return share.inline() if np.isfinite(share.value) else "-"


def illustrated(suite: Suite, found: Sequence[Found]) -> None:
    """What each costs, and how often it costs how much; nothing without plotly."""
    try:
        from .report.figures import curves, groups_with_interval
    except ModuleNotFoundError:
        return
    names = {each.kind: [w for _, w in contestants(each.kind)] for each in found}
    costs: dict[str, dict[str, Estimate]] = {}
    for each in found:
        logs = {who: np.log(np.minimum(each.ratios(who), FAILED)) for who in names[each.kind]}
        costs[each.kind] = {
            who: Estimate(*(100.0 * end for end in geometric_mean(log)))
            for who, log in logs.items()
        }
    label = "cost / nominal's, %: less is better"
    figure = groups_with_interval(costs, label, {100.0: NOMINAL})
    text = f"Geometric means over all conditions; a failure costs {FAILED:.0f} times nominal's."
    suite.answers.append(("Who holds the car where contests never are?", figure, text))
    for each in found:
        lines = {who: profile(each.ratios(who), _LEVELS) for who in names[each.kind]}
        label = "share of episodes that cost no more"
        figure = curves(_LEVELS, lines, "cost / nominal's on the same seed", label, "x")
        text = "A performance profile: the higher the better; a failure is never reached."
        suite.figures.append((f"{each.kind}: how often at what cost", figure, text))
