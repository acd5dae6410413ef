"""Search with Optuna over the logarithms of numbers, of estimators and of controllers.

A study lives in a database, so that a stopped search goes on and several machines can share one.
Needs the extra `tune`.
"""

import contextlib
import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import joblib
from rich.console import Console

from ... import __version__
from ...envs.numerics import require_extra
from ...envs.validation import check_choice
from ..harness.parallel import Bar
from ..harness.results import ResultTable

with require_extra("tune", "tuning needs optuna"):
    import cmaes  # noqa: F401  Optuna imports it when it is too late
    import optuna
    from optuna import Study
    from optuna.trial import FrozenTrial, TrialState
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import SQLAlchemyError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Range = tuple[float, float]  # (low, high), both positive
_BATCH = 8  # trials asked for before any result is in: the same search for every number of jobs
SAMPLERS = ("cma", "tpe")
STORAGE = "sqlite:///sideslip-tune.db"
_EDGE = 1.25  # times an end of its range or less: the number counts as being there


@dataclass(frozen=True)
class SearchOptions:
    """How long a study is searched, and by whom; ValueError where there are no trials."""

    trials: int  # of the study, the finished ones included
    storage: str = STORAGE  # RDB URL or SQLite file
    sampler: str = SAMPLERS[0]  # name in `SAMPLERS`
    seed: int = 0  # of the sampler
    jobs: int | None = None  # processes, None for all processors
    console: Console | None = None  # where progress is shown

    def __post_init__(self) -> None:
        if self.trials < 1:
            raise ValueError(f"trials must be at least 1, got {self.trials}")

    @property
    def workers(self) -> int:
        """Number of processes, the same for every batch; joblib ends them where it changes."""
        return min(self.jobs or joblib.cpu_count(), _BATCH)


def make_study_name(subject: str, question: "DataclassInstance", sources: str) -> str:
    """Make the name of a study: one for the same question, asked of the same sources.

    Args:
        subject: Beginning of the name.
        question: What is searched.
        sources: Hash of the sources on which the answer depends.
    """
    text = json.dumps(asdict(question), sort_keys=True, default=str)
    digest = hashlib.sha256(f"{text} {sources} {__version__}".encode()).hexdigest()
    return f"{subject} {digest[:12]}"


def run_study(
    name: str, ranges: Mapping[str, Range], search: SearchOptions,
    evaluate: Callable[[Sequence[dict[str, float]]], Sequence[tuple[float, int]]], n_drives: int,
    start: Mapping[str, float] | None = None,
) -> list[FrozenTrial]:  # fmt: skip
    """Run batches of trials until a study has so many, those it holds included.

    Args:
        name: Name of the study; ValueError where the storage fails or holds something else.
        ranges: Range of each number by name.
        search: Options of the search; machines that share a storage take different seeds.
        evaluate: Function of the numbers of a batch: value, and drives it is the mean of, of each.
        n_drives: Drives of a complete trial; one of fewer counts as pruned.
        start: Numbers of the first trial; None: the sampler's.

    Returns:
        The finished trials, with "objective" and "seeds" (drives) among their `user_attrs`.
    """
    study = load_study(name, ranges, search)
    space: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(*limits, log=True)
        for name, limits in ranges.items()
    }
    with _convert_storage_errors(search.storage), Bar(search.console) as bar:
        done, trials = _list_finished(study, ranges), search.trials
        if start is not None and not done:
            study.enqueue_trial(dict(start))
        shown = bar.add_task("search", total=trials, completed=len(done), unit="trials")
        while len(done) < trials:
            batch = [study.ask(space) for _ in range(min(_BATCH, trials - len(done)))]
            results = evaluate([trial.params for trial in batch])
            for trial, (value, count) in zip(batch, results, strict=True):
                trial.set_user_attr("seeds", count)
                trial.set_user_attr("objective", value)
                if count < n_drives:
                    trial.report(value, count)
                    study.tell(trial, state=TrialState.PRUNED)
                else:
                    study.tell(trial, value)
            done = _list_finished(study, ranges)
            complete = (trial for trial in done if trial.state is TrialState.COMPLETE)
            best = min((trial.user_attrs["objective"] for trial in complete), default=math.inf)
            bar.update(shown, completed=len(done), description=f"best {best:.4g}")
    return done


def load_study(name: str, ranges: Mapping[str, Range], search: SearchOptions) -> Study:
    """Create or load a study; ValueError for a storage that fails, or holds something else."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # else each trial has a line
    storage = search.storage
    url = storage if "://" in storage else f"sqlite:///{storage}"
    wait = {"connect_args": {"timeout": 60.0}} if url.startswith("sqlite") else {}
    # RuntimeError: another Optuna's tables, ImportError: no driver
    with _convert_storage_errors(storage, RuntimeError, ImportError):
        database = optuna.storages.RDBStorage(url, engine_kwargs=wait)
        study = optuna.create_study(
            storage=database, study_name=name, direction="minimize", load_if_exists=True
        )
        study.sampler = _make_sampler(search.sampler, search.seed + len(study.trials), len(ranges))
        _list_finished(study, ranges)
        return study


def _list_finished(study: Study, ranges: Mapping[str, Range]) -> list[FrozenTrial]:
    states = (TrialState.COMPLETE, TrialState.PRUNED)
    done = study.get_trials(deepcopy=False, states=states)
    if len(study.directions) != 1 or any(set(t.params) != set(ranges) for t in done):
        raise ValueError(f"the study {study.study_name!r} holds something else; delete it")
    return done


def _make_sampler(name: str, seed: int, size: int) -> "optuna.samplers.BaseSampler":
    """Make a sampler; TPE for a single number, which CMA-ES cannot search."""
    check_choice("sampler", name, SAMPLERS)
    if name == "tpe" or size == 1:
        return optuna.samplers.TPESampler(seed=seed)
    return optuna.samplers.CmaEsSampler(seed=seed)


@contextlib.contextmanager
def _convert_storage_errors(storage: str, *others: type[Exception]) -> Iterator[None]:
    """Convert errors of databases and Optuna to ValueError, without the password."""
    kinds: tuple[type[Exception], ...] = (SQLAlchemyError, optuna.exceptions.OptunaError, *others)
    try:
        yield
    except kinds as error:
        try:
            shown = make_url(storage).render_as_string(hide_password=True)
        except SQLAlchemyError:
            shown = storage.rpartition("@")[2]
        cause = error.__cause__ or error
        reason = str(getattr(cause, "orig", None) or cause).strip().splitlines()[0]
        raise ValueError(f"the study's storage failed ({shown}): {reason}") from None


def make_result_table(numbers: Mapping[str, float], ranges: Mapping[str, Range]) -> ResultTable:
    """Make a table of the numbers that were found, marked at the end of their ranges."""
    cells = []
    for name, (low, high) in ranges.items():
        value = numbers[name]
        remark = "at its end" if min(value / low, high / value) < _EDGE else ""
        cells.append([name, f"{value:g}", f"{low:g} .. {high:g}", remark])
    note = "A number at the end of its range: the optimum does without it, or lies beyond."
    return ResultTable("Found", ("option", "value", "range", ""), cells, note, keyed=False)
