"""What a filter's tick costs beside FilterPy's, and what late samples add to it."""

import math
from typing import Any

import gymnasium as gym
import numpy as np

from ...agents.rollout import rollout
from ...envs.record import PACKET, Record
from ...estimators.estimator import Estimator
from ...estimators.make import make_estimator
from ...estimators.vector.make import make_batch
from ..harness.drives import Drive, facts_of
from ..harness.results import Row, Suite, Table
from .filterpy_rival import OURS, Rival, four_states, six_states
from .timing import Contestant, Effort, interleaved, ratios, spread

TICKS = 3000  # of the drive
LATE = 0.030  # s
FRAMES = (0, 1, 2, 4, 8)  # under way at once
RULES = ("clone", "buffer")
REPEATS = 5  # of a log, so that its time is far above the clock's grain
BATCH, BLOCK, BLOCKS = 1024, 10, 33  # filters; ticks a call; calls

FOUR, SIX, REWIND = "FilterPy, n = 4", "FilterPy, n = 6", "FilterPy, n = 4, rewind by hand"


def drive(delay: float) -> Drive:
    """The start of tie-vision-fig7 with the camera so many seconds late."""
    scenario = {
        "base": "tie-vision-fig7",
        "camera_delays": [delay],
        "duration": TICKS * 1e-3,
    }
    env: gym.Env[Any, Any] = gym.make("sideslip/YawVision-v0", scenario=scenario, control_period=1)
    return Drive(rollout(env).log, facts_of(env.unwrapped))


def ours(name: str, drive: Drive, **options: Any) -> Estimator:
    """A filter of ours that computes its covariance as it goes."""
    return make_estimator(name, **drive.facts, gains="covariance", **OURS[name], **options)


def _whole(estimator: Estimator, record: Record) -> Contestant:
    """The log in one call."""

    def work() -> None:
        for _ in range(REPEATS):
            estimator.run(record)

    return Contestant(work, REPEATS * len(record.fast))


def _single(estimator: Estimator, record: Record, checked: bool = True) -> Contestant:
    """A tick a call, as on the road; unchecked as `take` has it, which the wrappers use."""
    arrived = record.packets[:, PACKET.arrived]
    cuts = np.searchsorted(arrived, record.ticks)
    packets = np.split(record.packets, cuts[1:])
    rows = np.split(record.fast, len(record.fast))
    steps = list(zip(rows, packets, strict=True))

    def work() -> None:
        estimator.reset()
        if checked:
            for row, here in steps:
                estimator.step(row, here)
        else:
            for row, here in steps:
                estimator.take(row, 1, here, len(here))

    return Contestant(work, len(steps))


def _batch(name: str, drive: Drive) -> Contestant:
    """A control period of many filters a call, each with its own covariance."""
    batch = make_batch(name, BATCH, gains="covariance", **drive.facts, **OURS[name])
    record = drive.log.record
    arrived = np.searchsorted(record.packets[:, PACKET.arrived], record.ticks[::BLOCK])
    blocks = []
    for i in range(min(BLOCKS, len(arrived) - 1)):
        fast = record.fast[i * BLOCK : (i + 1) * BLOCK]
        packets = record.packets[arrived[i] : arrived[i + 1]]
        blocks.append([np.repeat(rows[None], BATCH, axis=0) for rows in (fast, packets)])

    def work() -> None:
        batch.reset()
        for fast, packets in blocks:
            batch.step(fast, packets)

    return Contestant(work, BATCH * BLOCK * len(blocks))


def _rival(kf: Any, drive: Drive, late: int = 0) -> Contestant:
    rival, record = Rival(kf, drive.facts["vehicle"], late), drive.log.record
    return Contestant(lambda: rival.run(record), len(record.fast))


def contestants() -> dict[str, tuple[Contestant, str]]:
    """Name to contestant and the FilterPy filter it is compared with; FilterPy's own first."""
    prompt, late = drive(0.0), drive(LATE)
    car = (prompt.facts["vehicle"], prompt.facts["speed"], prompt.facts["dt"])
    multi = ours("multirate-kf", prompt)
    exact = ours("exact-kf", prompt)
    clone = ours("multirate-kf", late)
    return {
        FOUR: (_rival(four_states(*car), prompt), FOUR),
        "n = 4, a tick a call": (_single(multi, prompt.log.record), FOUR),
        "n = 4, a tick a call, unchecked": (_single(multi, prompt.log.record, False), FOUR),
        "n = 4, a log a call": (_whole(multi, prompt.log.record), FOUR),
        SIX: (_rival(six_states(*car), prompt), SIX),
        "n = 6, a log a call": (_whole(exact, prompt.log.record), SIX),
        f"n = 6, {BATCH} filters a call": (_batch("exact-kf", prompt), SIX),
        REWIND: (_rival(four_states(*car), late, round(LATE / car[2])), REWIND),
        "n = 4, 30 ms late, a tick a call": (_single(clone, late.log.record), REWIND),
        "n = 4, 30 ms late, a log a call": (_whole(clone, late.log.record), REWIND),
    }


def _interleaved(contestants: dict[str, Contestant], effort: Effort) -> dict[str, list[float]]:
    """CPU time alone."""
    return {name: taken.cpu for name, taken in interleaved(contestants, effort).items()}


def add(suite: Suite, effort: Effort) -> None:
    """Rows, tables and figures of the filters."""
    try:
        _beside_filterpy(suite, effort)
    except ModuleNotFoundError as missing:  # shown where it is installed
        if missing.name != "filterpy":
            raise
    _against_frames(suite, effort)


def _row(suite: Suite, estimator: str, metric: str, values: list[float]) -> list[str]:
    """A row of the suite; median and range as text."""
    middle, low, high = spread(values)
    suite.rows.append(
        Row(
            suite.name,
            "tie-vision-fig7",
            metric,
            middle,
            estimator=estimator,
            low=low,
            high=high,
            n=len(values),
        )
    )
    return [f"{middle:.3g}", f"{low:.3g} .. {high:.3g}"]


def _beside_filterpy(suite: Suite, effort: Effort) -> None:
    pairs = contestants()
    rounds = _interleaved({name: contestant for name, (contestant, _) in pairs.items()}, effort)
    cells = []
    for name, (_, rival) in pairs.items():
        text = [name, *_row(suite, name, "us_per_tick", rounds[name])]
        if name != rival:
            faster = ratios(rounds[rival], rounds[name])
            text += _row(suite, f"{rival} over {name}", "ratio", faster)
        else:
            text += ["", ""]
        cells.append(text)
    suite.tables.append(
        Table(
            "Cost of a filter's tick",
            ("filter", "us per tick", "range", "FilterPy over ours", "range"),
            cells,
            "The same model, noise and record, and the same estimates. Every filter computes its "
            "covariance at every tick. Late samples are used exactly: ours measure clones of what "
            "was captured, FilterPy is taken back by hand and repeats the ticks since.",
        )
    )


def delay_of(frames: int) -> float:
    """Seconds of delay that keep so many frames of the camera under way."""
    return max(0.0, frames * 0.033 - 0.003)


def _against_frames(suite: Suite, effort: Effort) -> None:
    """Cost of exactness against frames under way, for each rule that there is."""
    pairs: dict[tuple[str, int], Contestant] = {}
    for frames in FRAMES:
        late = drive(delay_of(frames))
        for rule in RULES:
            try:
                pairs[rule, frames] = _whole(
                    ours("multirate-kf", late, delay=rule), late.log.record
                )
            except ValueError:  # a rule that is not there
                continue
    rules = [rule for rule in RULES if (rule, 0) in pairs]
    labels = {pair: f"{pair[0]}, {pair[1]} frames under way" for pair in pairs}
    rounds = _interleaved({labels[pair]: work for pair, work in pairs.items()}, effort)
    cells, lines = [], {rule: list[float]() for rule in rules}
    for frames in FRAMES:
        text = [str(frames), f"{1e3 * delay_of(frames):.0f}"]
        for rule in rules:
            if (rule, frames) not in pairs:
                text += ["", ""]
                lines[rule].append(math.nan)
                continue
            taken, prompt = rounds[labels[rule, frames]], rounds[labels[rule, 0]]
            text += _row(suite, labels[rule, frames], "us_per_tick", taken)[:1]
            more = ratios(taken, prompt)
            text += _row(suite, f"{labels[rule, frames]}, over none", "ratio", more)[:1]
            lines[rule].append(spread(more)[0])
        cells.append(text)
    header = ["frames under way", "ms late"]
    for rule in rules:
        header += [f"{rule}, us per tick", "over none"]
    suite.tables.append(
        Table(
            "Cost of using late samples exactly",
            header,
            cells,
            "multirate-kf, n = 4, with its covariance, beside itself without delay.",
        )
    )
    _draw(suite, lines)


def _draw(suite: Suite, lines: dict[str, list[float]]) -> None:
    """The curve; nothing where plotly is not installed."""
    try:
        from ..report.figures import time_series
    except ModuleNotFoundError:
        return
    figure = time_series(
        np.array(FRAMES, float),
        {rule: np.array(line) for rule, line in lines.items()},
        "cost of a tick over that without delay",
        "camera frames under way",
    )
    text = "Exactness is a matter of frames: one more row of clones for each that is under way."
    suite.figures.append(("Cost of exactness against frames under way", figure, text))
