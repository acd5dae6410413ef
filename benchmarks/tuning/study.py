"""Search with Optuna over the logarithms of numbers, and its result for estimators as a suite.

A study lives in a database, so that a stopped search goes on and several machines can share one. It
is searched on training seeds and judged on test seeds. Needs the extra `tune`.
"""

import contextlib
import dataclasses
import functools
import math
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import joblib
import numpy as np

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...estimators.design.options import TUNINGS
from ...estimators.estimator import Estimator
from ...estimators.make import make_estimator
from ..harness.drives import SETTLED, LoggedEpisode, call_quietly
from ..harness.parallel import Bar, count_cores, run_cases
from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate, interval, ratio_of_roots, root_mean
from .estimator import SAMPLERS, STORAGE, EstimatorTuning, SearchOptions, simulate

with require_extra("tune", "tuning needs optuna"):
    import cmaes  # noqa: F401  Optuna imports it when it is too late
    import optuna
    from optuna.trial import FrozenTrial, TrialState
    from sqlalchemy.engine import make_url
    from sqlalchemy.exc import SQLAlchemyError

BATCH = 8  # trials asked for before any result is in: the same search for every number of jobs


class _Question(Protocol):
    """Name of a study, and the (low, high) of each number by name."""

    @property
    def study(self) -> str: ...

    @property
    def search(self) -> Mapping[str, tuple[float, float]]: ...


@functools.lru_cache(maxsize=1)
def _load_drives(path: str) -> list[LoggedEpisode]:
    drives: list[LoggedEpisode] = joblib.load(path)
    return drives


def _compute_squares(
    task: EstimatorTuning, drives: Sequence[LoggedEpisode], values: Mapping[str, float]
) -> Array:
    """Compute the target's mean squared error from `SETTLED` s on, shape (scenarios, seeds)."""
    options, turn = task.options | dict(values), 2.0 * math.pi
    errors, filters = np.empty(len(drives)), dict[str, Estimator]()
    for i, (log, facts) in enumerate((drive.log, drive.facts) for drive in drives):
        clocks = [dataclasses.replace(sensor, phase=0.0) for sensor in facts["sensors"].values()]
        key = repr(facts | {"sensors": clocks})  # a reset sets the clocks' phases
        if key not in filters:
            filters[key] = call_quietly(make_estimator, task.estimator, **facts, **options)
        late = log.time >= SETTLED - 1e-9
        with np.errstate(all="ignore"):
            error = (filters[key].run(log)[task.target] - log.truth[task.target])[late]
            if task.unit == "rad":
                error = np.remainder(error + math.pi, turn) - math.pi
            errors[i] = np.mean(error**2)
    finite = np.where(np.isfinite(errors), errors, np.inf)
    return finite.reshape(len(task.scenarios), -1)


def _compute_stable_squares(
    task: EstimatorTuning, drives: Sequence[LoggedEpisode], values: Mapping[str, float]
) -> Array:
    """Compute the squared errors, infinite where the estimator diverges."""
    try:
        return _compute_squares(task, drives, values)
    except ValueError:  # a filter that diverges, a covariance that is none
        return np.full((len(task.scenarios), len(drives) // len(task.scenarios)), np.inf)


def _compute_objective(errors: Array) -> float:
    """Compute the geometric mean of the scenarios' RMSE from squares (scenarios, seeds)."""
    return float(np.exp(np.mean(np.log(root_mean(errors)))))


def _evaluate_file(path: str, task: EstimatorTuning, values: dict[str, float]) -> float:
    """Evaluate the objective of some numbers on a file's drives; infinite if unstable."""
    return _compute_objective(_compute_stable_squares(task, _load_drives(path), values))


def create_study(
    task: _Question, storage: str = STORAGE, sampler: str = SAMPLERS[0], seed: int = 0
) -> "optuna.Study":
    """Create or load a task's study; ValueError for a storage that fails, or holds something else.

    Args:
        task: Question.
        storage: RDB URL or SQLite file.
        sampler: Name in `SAMPLERS`.
        seed: Seed of the sampler; machines that share a storage take different ones.
    """
    url = storage if "://" in storage else f"sqlite:///{storage}"
    wait = {"connect_args": {"timeout": 60.0}} if url.startswith("sqlite") else {}
    others = (RuntimeError, ImportError)  # another Optuna's tables, no driver
    with _silence_optuna(), _convert_storage_errors(storage, *others):
        database = optuna.storages.RDBStorage(url, engine_kwargs=wait)
        study = optuna.create_study(
            storage=database, study_name=task.study, direction="minimize", load_if_exists=True
        )
        study.sampler = _make_sampler(sampler, seed + len(study.trials), len(task.search))
        _list_finished(study, task)
        return study


def _search(
    study: "optuna.Study",
    task: EstimatorTuning,
    drives: Sequence[LoggedEpisode],
    search: SearchOptions,
) -> dict[str, float]:
    """Search on training drives until the study has so many trials; the best numbers, 3 digits."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "drives")  # from which workers read them
        joblib.dump(list(drives), path)
        evaluate = functools.partial(_evaluate_file, path, task)
        n_jobs = min(search.jobs or count_cores(), BATCH)

        def evaluate_batch(batch: Sequence[dict[str, float]]) -> list[tuple[float, int]]:
            return [(x, len(drives)) for x in run_cases(evaluate, batch, jobs=n_jobs)]

        run_search(study, task, search, evaluate_batch, len(drives))
    with _convert_storage_errors(study.study_name):
        best = study.best_trial
    if best.value is None or not math.isfinite(best.value):
        _compute_squares(task, drives, best.params)  # the estimator's own words, if it has any
        text = f"none of {search.trials} trials of {task.estimator} gave finite estimates"
        raise ValueError(text)
    return {name: float(f"{v:.3g}") for name, v in best.params.items()}


def run_search(
    study: "optuna.Study",
    task: _Question,
    search: SearchOptions,
    evaluate: Callable[[Sequence[dict[str, float]]], Sequence[tuple[float, int]]],
    n_drives: int,
) -> None:
    """Run batches of trials until the study has so many, those it holds included.

    Args:
        study: Study.
        task: Its question.
        search: Options of the search.
        evaluate: Function of the numbers of a batch: value, and drives it is the mean of, of each.
        n_drives: Drives of a complete trial; one of fewer counts as pruned.
    """
    space: dict[str, optuna.distributions.BaseDistribution] = {
        name: optuna.distributions.FloatDistribution(*limits, log=True)
        for name, limits in task.search.items()
    }
    with _silence_optuna(), _convert_storage_errors(study.study_name), Bar(search.console) as bar:
        done, trials = _list_finished(study, task), search.trials
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


def _list_finished(study: "optuna.Study", task: _Question) -> list[FrozenTrial]:
    states = (TrialState.COMPLETE, TrialState.PRUNED)
    done = study.get_trials(deepcopy=False, states=states)
    if len(study.directions) != 1 or any(set(t.params) != set(task.search) for t in done):
        raise ValueError(f"the study {study.study_name!r} holds something else; delete it")
    return done


def _make_sampler(name: str, seed: int, size: int) -> "optuna.samplers.BaseSampler":
    """Make a sampler; TPE for a single number, which CMA-ES cannot search."""
    if name not in SAMPLERS:
        raise ValueError(f"unknown sampler {name!r}; known: {', '.join(SAMPLERS)}")
    if name == "tpe" or size == 1:
        return optuna.samplers.TPESampler(seed=seed)
    return optuna.samplers.CmaEsSampler(seed=seed)


@contextlib.contextmanager
def _silence_optuna() -> Iterator[None]:
    """Mute Optuna's log and its warnings about experimental parts."""
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


def _format_best(study: "optuna.Study") -> str:
    try:
        return f"best {study.best_value:.4g}"
    except ValueError:
        return "search"


_EDGE = 1.25  # times an end of its range or less: the number counts as being there


def run(
    task: EstimatorTuning, search: SearchOptions, test_seeds: int = 20
) -> tuple[Suite, dict[str, float]]:
    """Search on the task's seeds, and judge on others; ValueError where no filter is stable.

    Args:
        task: Tuning.
        search: Options of the search.
        test_seeds: Number of test seeds, from 0 on.
    """
    if not 1 <= test_seeds <= task.seeds[0]:
        raise ValueError(f"test seeds are 1 to {task.seeds[0]}, got {test_seeds}")
    study = create_study(task, search.storage, search.sampler, search.seed)
    shown = search.jobs, search.console
    training = simulate(task, task.seeds, "training drives", *shown)
    numbers = _search(study, task, training, search)
    test = simulate(task, range(test_seeds), "test drives", *shown)
    text = (
        f"RMSE of {task.target} from 2 s on in {task.unit}, with 95 % intervals; "
        f"{search.trials} trials. The default is make_estimator with no more than what is held "
        "fixed. Several scenarios count alike: the search makes the geometric mean of their RMSE "
        "least."
    )
    comparisons = _make_comparisons(task, (training, test), numbers)
    tables = [*comparisons, make_result_table(numbers, task.search)]
    return Suite("tune", f"Tuning {task.estimator} on {task.subject}", text, tables=tables), numbers


def _make_comparisons(
    task: EstimatorTuning, groups: Sequence[Sequence[LoggedEpisode]], numbers: dict[str, float]
) -> list[ResultTable]:
    """Make a table of errors before and after for each scenario, in training and test drives."""
    default = [_compute_stable_squares(task, drives, {}) for drives in groups]
    tuned = [_compute_stable_squares(task, drives, numbers) for drives in groups]
    tables = []
    for i, scenario in enumerate(task.scenarios):
        before, after = [values[i] for values in default], [values[i] for values in tuned]
        ratio = Estimate(math.nan)
        if np.isfinite([before[1], after[1]]).all():
            ratio = interval(after[1], ratio_of_roots, before[1])
        title = f"{task.estimator} on {scenario} ({task.env_id})"
        heads = ("tuning", f"{before[0].size} training seeds", f"{before[1].size} test seeds")
        lines = [["default", *map(_format_spread, before)], ["found", *map(_format_spread, after)]]
        note = f"Found over default on the test seeds: {ratio.inline(digits='.3f')}."
        tables.append(ResultTable(title, heads, lines, note))
    return tables


def _format_spread(errors: Array) -> str:
    if not np.isfinite(errors).all():
        return "diverges"
    return interval(errors, root_mean).inline(digits=".4g")


def make_result_table(
    numbers: Mapping[str, float], search: Mapping[str, tuple[float, float]]
) -> ResultTable:
    """Make a table of the numbers that were found, marked at the end of their ranges.

    Args:
        numbers: Value by name.
        search: Range (low, high) by name.
    """
    cells = []
    for name, (low, high) in search.items():
        value = numbers[name]
        remark = "at its end" if min(value / low, high / value) < _EDGE else ""
        cells.append([name, f"{value:g}", f"{low:g} .. {high:g}", remark])
    note = "A number at the end of its range: the optimum does without it, or lies beyond."
    return ResultTable("Found", ("option", "value", "range", ""), cells, note, keyed=False)


def make_entry(
    task: EstimatorTuning, numbers: dict[str, float], command: str, note: str = ""
) -> dict[str, object]:
    """Make the entry of a tunings file from the numbers that a command found.

    Args:
        task: Tuning.
        numbers: Value by option.
        command: Command that found them.
        note: Remark, "" for none.
    """
    used = task.options | numbers
    q = {key.removeprefix("q_"): value for key, value in used.items() if key.startswith("q_")}
    q = TUNINGS.get((task.estimator, task.sensors), {}) | q
    noise = {key: value for key, value in numbers.items() if not key.startswith("q_")}
    known = {"estimator": task.estimator, "sensors": task.sensors, "command": command}
    return {**known, "q": q, "noise": noise, **({"note": note} if note else {})}
