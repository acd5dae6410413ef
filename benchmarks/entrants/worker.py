"""A user's contestant in a process of its own, which never holds the env, its seeds or a result."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...agents.env_facts import EnvView
from ...agents.learned.files import ZIP
from ...envs.sensors.link import SlowSensor
from ...estimators.user_files import is_user_file
from ...estimators.vector.foreign import ForeignBatch
from ...estimators.wrappers.outputs import write
from ..control.episodes import NUMBERS, Chunk, Driven, drive
from .process import Child, ContestantError

LIMIT = 600.0  # s of wall time a cell


class RemoteAgent:
    """The agent of a child, as `make_agent` takes a factory and an agent.

    Args:
        child: Where it is built and asked.
        source: The text of which the child makes it.
        trust: Whether the child may read a zip.
    """

    def __init__(self, child: Child, source: str, trust: bool = False) -> None:
        self._child, self._source, self._trust = child, source, trust

    def __call__(self, env: Any, **options: Any) -> "_Answers":
        """Let the child build its agent from the view of an env."""
        view = EnvView.from_env(env)
        self._child.ask("agent", self._source, view, {"trust": self._trust, **options})
        return _Answers(self._child, (view.num_envs, view.facts.width))


class _Answers:
    def __init__(self, child: Child, shape: tuple[int, int]) -> None:
        self._child, self._shape = child, shape

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:  # fmt: skip
        """The child's actions, float32 (rows, width); its memory stays there."""
        length = 4 * self._shape[0] * self._shape[1]
        answer = self._child.ask("predict", observation, episode_start, length=length)
        return np.frombuffer(answer, np.float32).reshape(self._shape), None


class RemoteEstimators:
    """The estimators of a child, as `make_estimator` takes a factory.

    Args:
        child: Where they are built and asked.
        source: The text of which the child makes them.
    """

    def __init__(self, child: Child, source: str) -> None:
        self._child, self.name, self._rows = child, source, 0

    def __call__(self, **arguments: Any) -> "_RemoteRow":
        """Let the child build one more estimator."""
        row, self._rows = self._rows, self._rows + 1
        return _RemoteRow(self._child, self.name, row, arguments)


class RemoteBatch(ForeignBatch):
    """The estimators of a child, all rows in one message."""

    def take(
        self, mask: Any, fast: Any, rows: Any, packets: Any, counts: Any, *observed: Any
    ) -> None:
        """As `BatchEstimator.take`."""
        obs, inner, plan, limits, *others = observed
        chosen = np.arange(len(self)) if mask is None else np.flatnonzero(mask)
        remote: list[Any] = [self[i].inner for i in chosen.tolist()]
        records = [
            (each.row, fast[i, : rows[i]], packets[i, : counts[i]])
            for i, each in zip(chosen.tolist(), remote, strict=True)
        ]
        _RemoteRow.take(remote, records)
        for i in chosen.tolist():
            beta, gamma, out, summary = (each[i] for each in others)
            write(self[i], obs[i], inner, plan, limits, beta, gamma, out, summary)


class _RemoteRow:
    """One estimator of a child, as an `EstimatorLike`."""

    batch = RemoteBatch
    x: Any = None
    P: Any = None

    def __init__(self, child: Child, source: str, row: int, arguments: dict[str, Any]) -> None:
        self.child, self.row = child, row
        names = json.loads(child.ask("estimator", row, source, arguments))
        self.names = tuple(names) if isinstance(names, list) else ()

    def reset(self, sensors: Mapping[str, SlowSensor], first: int) -> None:
        """As `EstimatorLike.reset`."""
        self.child.ask("reset", self.row, dict(sensors), first)

    def step(self, rows: Any, packets: Any) -> None:
        """As `EstimatorLike.step`."""
        self.take([self], [(self.row, rows, packets)])

    @staticmethod
    def take(rows: Sequence["_RemoteRow"], records: Sequence[tuple[int, Any, Any]]) -> None:
        """Step some rows of one child with their records; set each one's x and P."""
        if not rows:
            return
        n = len(rows[0].names)
        answer = rows[0].child.ask("step", records, length=8 * len(rows) * n * (n + 1))
        for each, values in zip(rows, np.frombuffer(answer).reshape(len(rows), -1), strict=True):
            each.x, each.P = values[:n], values[n:].reshape(n, n)


def is_foreign(source: Any) -> bool:
    """Whether a text names code that is not the package's."""
    return isinstance(source, str) and (
        is_user_file(source) or source.endswith(ZIP) or ":" in source
    )


def drive_users(chunk: Chunk) -> Driven:
    """`drive`; a cell of which every episode ends by an action that is none was not driven."""
    driven = drive(chunk)
    if not driven.error and driven.failed("bad-action").all():
        return _undriven(chunk, "every action is NaN, or infinite, before an episode is over")
    return driven


def drive_apart(chunk: Chunk, limit: float = LIMIT, allowed: Iterable[str] | None = None) -> Driven:
    """`drive_users`, but what is not the package's code runs in a child of its own, agent and
    estimator apart.

    Args:
        chunk: Whose contestants are names and files.
        limit: Seconds of wall time.
        allowed: Files that a child may open, of `Start`.

    Returns:
        The episodes.
    """
    return _drive_apart(chunk, limit, allowed)[0]


def rehearse(chunk: Chunk, limit: float = LIMIT) -> tuple[Driven, set[str]]:
    """Drive a chunk as `drive_apart`; return the files that its contestants opened, too."""
    return _drive_apart(chunk, limit, None)


def _drive_apart(
    chunk: Chunk, limit: float, allowed: Iterable[str] | None
) -> tuple[Driven, set[str]]:
    cell, children, opened = chunk.cell, list[Child](), set[str]()
    objects = dict(cell.objects)
    try:
        for part in ("controller", "estimator"):
            source = getattr(cell, part)
            if part in objects or not is_foreign(source):
                continue
            child = Child((cell.controller, cell.estimator), limit, allowed)
            children.append(child)
            trust = bool(cell.best["controller"].get("trust"))
            agent = part == "controller"
            objects[part] = (
                RemoteAgent(child, source, trust) if agent else RemoteEstimators(child, source)
            )
        driven = drive_users(replace(chunk, cell=replace(cell, objects=objects)))
        for child in children:
            if not child.reason:
                opened.update(json.loads(child.ask("opened")))
    except ContestantError as error:
        driven = _undriven(chunk, str(error))
    finally:
        spent = sum(child.close() for child in children)
    reason = next((child.reason for child in children if child.reason), driven.error)
    if reason:
        return _undriven(chunk, reason), opened
    return replace(driven, seconds=driven.seconds + spent), opened


def _undriven(chunk: Chunk, error: str) -> Driven:
    return Driven(np.full((len(chunk.seeds), len(NUMBERS)), np.nan), np.nan, error=error)
