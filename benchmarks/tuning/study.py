"""The search of a tuning with Optuna: the logarithms of the numbers, on the training drives.

A study lives in a database, so that a search that was stopped goes on and several machines can
share one. Importing this module needs optuna, the extra `tune`.
"""

import contextlib
import functools
import math
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import joblib
from rich.console import Console

from ...envs.backend.extras import require_extra
from ..harness.drives import LoggedEpisode
from ..harness.engines import count_cores
from ..harness.parallel import Bar, run_cases
from .task import SAMPLERS, STORAGE, EstimatorTuning, compute_objective, compute_squares

with require_extra("tune", "tuning needs optuna"):
    import cmaes  # noqa: F401  Optuna imports it when it is too late
    import optuna
    from optuna.trial import FrozenTrial, TrialState
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import SQLAlchemyError

BATCH = 8  # trials asked for before any result is in: the same search for every number of jobs
DIGITS = 3  # of what is found


class Question(Protocol):
    """What a study is about: its name, and the (low, high) of each number by name."""

    @property
    def study(self) -> str: ...  # noqa: D102

    @property
    def search(self) -> Mapping[str, tuple[float, float]]: ...  # noqa: D102


@functools.lru_cache(maxsize=1)
def _load_drives(path: str) -> Any:
    return joblib.load(path)


def evaluate_trial(path: str, task: EstimatorTuning, values: dict[str, float]) -> float:
    """`objective` with some numbers, on the drives in a file; infinite if unstable."""
    try:
        return compute_objective(compute_squares(task, _load_drives(path), values))
    except ValueError:  # a filter that diverges, a covariance that is none
        return math.inf


def create_study(
    task: Question, storage: str = STORAGE, sampler: str = SAMPLERS[0], seed: int = 0
) -> "optuna.Study":
    """The task's study, made if it is not there.

    storage: an RDB URL, or the path of an SQLite file. Machines that share one take different
    seeds. Raises ValueError for an unknown sampler, a storage that cannot be used, and a study that
    holds something else.
    """
    url = storage if "://" in storage else f"sqlite:///{storage}"
    wait = {"connect_args": {"timeout": 60.0}} if url.startswith("sqlite") else {}
    others = (RuntimeError, ImportError)  # another Optuna's tables, no driver
    with _silence_optuna(), _convert_storage_errors(storage, *others):
        study = optuna.create_study(
            storage=optuna.storages.RDBStorage(url, engine_kwargs=wait),
            study_name=task.study,
            direction="minimize",
            load_if_exists=True,
        )
        study.sampler = _make_sampler(sampler, seed + len(study.trials), len(task.search))
        _list_finished(study, task)
        return study


def search(
    study: "optuna.Study",
    task: EstimatorTuning,
    drives: Sequence[LoggedEpisode],
    trials: int,
    jobs: int | None = None,
    console: Console | None = None,
) -> dict[str, float]:
    """The best numbers after so many trials of the task's study, those it holds included.

    Raises ValueError for a storage that fails and where no trial gave a stable filter.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "drives")
        joblib.dump(list(drives), path)
        n_jobs = min(jobs or count_cores(), BATCH)

        def evaluate_batch(batch: Sequence[dict[str, float]]) -> list[tuple[float, int]]:
            values = run_cases(functools.partial(evaluate_trial, path, task), batch, jobs=n_jobs)
            return [(value, len(drives)) for value in values]

        run_search(study, task, trials, evaluate_batch, len(drives), console)
    with _convert_storage_errors(study.study_name):
        best = study.best_trial
    if best.value is None or not math.isfinite(best.value):
        compute_squares(task, drives, best.params)  # the estimator's own words, if it has any
        raise ValueError(f"none of {trials} trials of {task.estimator} gave finite estimates")
    return {name: float(f"{v:.{DIGITS}g}") for name, v in best.params.items()}


def run_search(
    study: "optuna.Study",
    task: Question,
    trials: int,
    evaluate: Callable[[Sequence[dict[str, float]]], Sequence[tuple[float, int]]],
    n_drives: int,
    console: Console | None = None,
) -> None:
    """Ask for batches until the study has so many trials, those it holds included.

    evaluate: from the numbers of a batch to (value, drives it is the mean of) of each. A trial that
    drove fewer than `n_drives` counts as pruned; its user attributes have both.
    """
    space: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(*limits, log=True)
        for name, limits in task.search.items()
    }
    with _silence_optuna(), _convert_storage_errors(study.study_name), Bar(console) as bar:
        done = _list_finished(study, task)
        shown = bar.add_task(_format_best(study), total=trials, completed=len(done), unit="trials")
        while len(done) < trials:
            batch = [study.ask(space) for _ in range(min(BATCH, trials - len(done)))]
            results = evaluate([trial.params for trial in batch])
            for trial, (value, count) in zip(batch, results, strict=True):
                trial.set_user_attr("seeds", count)
                trial.set_user_attr("objective", value)
                if count < n_drives:
                    trial.report(value, count)
                    study.tell(trial, state=TrialState.PRUNED)
                else:
                    study.tell(trial, value)
            done = _list_finished(study, task)
            bar.update(shown, completed=len(done), description=_format_best(study))


def _list_finished(study: "optuna.Study", task: Question) -> list[FrozenTrial]:
    states = (TrialState.COMPLETE, TrialState.PRUNED)
    done = study.get_trials(deepcopy=False, states=states)
    if len(study.directions) != 1 or any(set(t.params) != set(task.search) for t in done):
        raise ValueError(f"the study {study.study_name!r} holds something else; delete it")
    return done


def _make_sampler(name: str, seed: int, size: int) -> "optuna.samplers.BaseSampler":
    """CMA-ES has no use for a single number."""
    if name not in SAMPLERS:
        raise ValueError(f"unknown sampler {name!r}; known: {', '.join(SAMPLERS)}")
    if name == "tpe" or size == 1:
        return optuna.samplers.TPESampler(seed=seed)
    return optuna.samplers.CmaEsSampler(seed=seed)


@contextlib.contextmanager
def _silence_optuna() -> Iterator[None]:
    """Without Optuna's log and its warnings of what is experimental."""
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)


@contextlib.contextmanager
def _convert_storage_errors(storage: str, *others: type[Exception]) -> Iterator[None]:
    """ValueError, without the password, for what databases and Optuna raise."""
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


def _format_best(study: "optuna.Study") -> str:
    try:
        return f"best {study.best_value:.4g}"
    except ValueError:
        return "search"
