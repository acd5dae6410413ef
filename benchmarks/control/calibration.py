"""The clairvoyant's costs, contest by contest, on seeds of their own that only the version salts.

Solving for it takes ten seconds an episode, so it is done once, by `sideslip calibrate`, and lies
in a file. The rungs of the ladder drive the same seeds when a table is made. An entry that no
longer fits, by its version, its contest, or what the uncontrolled car costs on its seeds, is
refused.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

from ... import __version__
from ...envs.arguments import is_finite
from ..harness.parallel import run_cases
from ..harness.results import made_of, read_objects, write_text
from .cells import Cell
from .contests import NOMINAL, STATE, Contest, oracle_of
from .episodes import Array
from .run import Results, measure, sources
from .scores import gains, survived

FILE = Path(__file__).with_name("clairvoyant.json")
SEEDS = 64
_FIRST = 2**30  # tests and tunings count their seeds from 0
_SAME = 1e-9  # of a cost


@dataclass(frozen=True)
class Case:
    """One episode of a contest."""

    contest: Contest
    seed: int
    folder: str  # of finished cases

    @property
    def path(self) -> Path:
        """The file of the finished case; other sources or another question give another name."""
        rung = oracle_of(self.contest)  # with which the search begins
        asked = [asdict(self.contest), rung, self.seed, sources(), __version__]
        digest = hashlib.sha256(json.dumps(asked).encode()).hexdigest()
        return Path(self.folder) / f"{digest[:24]}.json"


@dataclass(frozen=True)
class Episode:
    """What was found of one seed; the fields of `agents.clairvoyant.Ceiling` without actions."""

    seed: int
    cost: float
    winner: str
    costs: dict[str, float]
    statuses: dict[str, str]
    seconds: float


@dataclass(frozen=True)
class Entry:
    """A contest's episodes, and the command that made them."""

    tier: str
    env_id: str
    vehicle: str
    reference: str
    scenario: str
    env_version: str
    command: str
    episodes: tuple[Episode, ...]

    @property
    def contest(self) -> Contest:
        """Of which these are the costs."""
        return Contest(self.tier, self.env_id, self.vehicle, self.reference, self.scenario)

    @property
    def costs(self) -> Array:
        """(n,) the clairvoyant's."""
        return np.array([episode.cost for episode in self.episodes])


def seeds_of(contest: Contest, count: int = SEEDS) -> list[int]:
    """The first `count` seeds of a contest's calibration; more seeds begin with the same ones."""
    texts = [f"clairvoyant {__version__} {contest.seed_text} {i}" for i in range(count)]
    digests = [hashlib.sha256(text.encode()).digest() for text in texts]
    return [_FIRST + int.from_bytes(digest[:4]) % _FIRST for digest in digests]


def solve(case: Case) -> Episode:
    """The best of the plans from nominal's and the oracle's runs; from the folder of finished cases
    where it is there."""
    from ...agents.clairvoyant.plan import actions_of, ceiling
    from ...agents.rungs import make_rung

    done = _finished(case)
    if done is not None:
        return done
    contest, starts = case.contest, {}
    for name, rung in ((NOMINAL, NOMINAL), (STATE, oracle_of(contest))):
        driver = make_rung(rung, contest.env_id, **contest.env_options)
        starts[name] = actions_of(*driver, case.seed)
    env: gym.Env[Any, Any] = gym.make(contest.env_id, **contest.env_options)
    found = ceiling(env, case.seed, starts)
    seconds = round(found.seconds, 1)
    episode = Episode(case.seed, found.cost, found.winner, found.costs, found.statuses, seconds)
    write_text(case.path, json.dumps(asdict(episode)))
    return episode


def _finished(case: Case) -> Episode | None:
    """The episode of the case's file; None where it is absent or damaged."""
    try:
        entry = json.loads(case.path.read_text(encoding="utf-8"))
        episode = made_of(Episode, entry, str(case.path))
    except (OSError, ValueError, RecursionError):
        return None
    costs = [episode.cost, episode.costs.get("none", math.nan), episode.seconds]
    return episode if episode.seed == case.seed and all(map(is_finite, costs)) else None


def calibrate(
    contests: Sequence[Contest],
    folder: Path,
    seeds: int = SEEDS,
    command: str = "",
    jobs: int | None = None,
    console: Console | None = None,
) -> list[Entry]:
    """One entry a contest; folder: of finished cases, from which a stopped run goes on.

    Raises ValueError for fewer than two seeds (no interval), ModuleNotFoundError, with what to
    install, before the work rather than in a worker.
    """
    if seeds < 2:
        raise ValueError(f"an interval needs two seeds or more, got {seeds}")
    try:
        import casadi  # noqa: F401
        import osqp  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "the clairvoyant needs CasADi and OSQP: pip install 'sideslip[mpc]'"
        ) from None
    folder.mkdir(parents=True, exist_ok=True)
    cases = cases_of(contests, folder, seeds)
    episodes = run_cases(solve, cases, "calibration", jobs, console)
    return [
        Entry(
            **asdict(contest),
            env_version=__version__,
            command=command,
            episodes=tuple(episodes[i * seeds : (i + 1) * seeds]),
        )
        for i, contest in enumerate(contests)
    ]


def cases_of(contests: Sequence[Contest], folder: Path, seeds: int) -> list[Case]:
    """Every episode, contest by contest."""
    return [Case(c, seed, str(folder)) for c in contests for seed in seeds_of(c, seeds)]


def forget(cases: Sequence[Case]) -> None:
    """Remove finished cases once their entries are written; those of other runs stay."""
    for case in cases:
        case.path.unlink(missing_ok=True)
    folder = Path(cases[0].folder)
    if not any(folder.iterdir()):
        folder.rmdir()


def read_calibration(path: str | Path = FILE, stale: bool = False) -> dict[Contest, Entry]:
    """The entries of a file by contest. stale: those of another version or of other seeds are left
    out instead of refused.

    Raises FileNotFoundError where there is none, ValueError, with file, entry and field, for one
    that is cut short or lacks something, of another version or of other seeds.
    """
    entries = {}
    for i, each in enumerate(read_objects(path), 1):
        where = f"{path}: entry {i}"
        episodes = each.get("episodes", ())
        if not isinstance(episodes, list):
            raise ValueError(f"{where}: episodes is no list")
        made = (made_of(Episode, one, f"{where}, episode {k}") for k, one in enumerate(episodes, 1))
        entry = made_of(Entry, each | {"episodes": tuple(made)}, where)
        seeds, why = [one.seed for one in entry.episodes], ""
        if entry.env_version != __version__:
            why = f"of version {entry.env_version}, not {__version__}"
        elif seeds != seeds_of(entry.contest, len(seeds)):
            why = "its seeds are not this contest's"
        if why and not stale:
            raise ValueError(f"{where}, {entry.contest.name}, is stale: {why}")
        if not why:
            entries[entry.contest] = entry
    return entries


def update(path: str | Path, made: Sequence[Entry]) -> None:
    """Replace or add entries of a file, which is made if it is not there; its stale ones go."""
    entries = read_calibration(path, stale=True) if Path(path).exists() else {}
    entries |= {entry.contest: entry for entry in made}
    ordered = sorted(entries.values(), key=lambda entry: entry.contest.name)
    write_text(path, json.dumps([asdict(entry) for entry in ordered], indent=1) + "\n")


def check_fresh(entries: Mapping[Contest, Entry], path: str | Path = FILE) -> None:
    """ValueError, with the contest, where the uncontrolled car no longer costs what it did."""
    for contest, entry in entries.items():
        cell, seeds = Cell(contest, "", "none"), [episode.seed for episode in entry.episodes]
        now = measure([cell], seeds, jobs=1).found[cell]
        then = np.array([episode.costs["none"] for episode in entry.episodes])
        if now.error or not np.allclose(now.costs, then, rtol=_SAME, atol=0.0):
            raise ValueError(
                f"{path}: {contest.name} is stale: the uncontrolled car costs {now.costs[0]:.6g} "
                f"on its first seed, {then[0]:.6g} when it was calibrated; run sideslip calibrate"
            )


def driven_there(
    entries: Mapping[Contest, Entry], cells: Sequence[Cell], **options: Any
) -> Results:
    """The cells of calibrated contests on the clairvoyant's seeds; options: of `measure`."""
    seeds = {contest: [each.seed for each in entry.episodes] for contest, entry in entries.items()}
    mine = [cell for contest in entries for cell in cells if cell.contest == contest]
    return measure(mine, seeds.__getitem__, title="control, the clairvoyant's seeds", **options)


def leads(entries: Mapping[Contest, Entry], there: Results) -> dict[Cell, Array]:
    """(n,) log(J / J_clairvoyant) of each cell on the seeds that it survives."""
    found = {}
    for cell, driven in there.found.items():
        if not driven.error and survived(driven).any():
            best = entries[cell.contest].costs[: len(driven.costs)]
            found[cell] = -gains(best, driven)[survived(driven)]
    return found
