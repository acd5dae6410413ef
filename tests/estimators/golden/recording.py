"""What every default filter says of one drive, so that numbers do not change unnoticed.

`python -m tests.estimators.golden` (from the checkout's root) records anew those that moved by more
than the tolerance; the diff of the tables then shows which and by how much.
"""

import csv
import warnings
from pathlib import Path

import numpy as np

from sideslip.envs import Log, StabilityEnv
from sideslip.envs.record import PACKET, Fast, concatenate
from sideslip.envs.scenarios.manoeuvres import make_scenario
from sideslip.envs.vehicle.parameters import Vehicle
from sideslip.estimators import FILTERS, UnobservableWarning, make_estimator

FOLDER = Path(__file__).parent
INSTANTS = 249 * np.arange(
    1, 21
)  # ticks; they meet many phases of the camera's 33 and the GPS's 200
DIGITS = 12
TOLERANCE = 1e-9  # of a column's range
CASES = [(name, sensor) for name, row in FILTERS.items() for sensor in row.slow or ("",)]

Table = tuple[list[str], np.ndarray]
"""Names of columns, the first of which is "tick", and rows."""


def drive() -> tuple[Log, Vehicle]:
    """5 s that excite every model, and the vehicle that filters are told: a slalom whose speed
    wanders, tyres and roll model 30 % off, camera and GPS."""
    scenario = make_scenario("double-layer-fig9").replace(duration=5.0)
    env = StabilityEnv("fusion", scenario, control_period=1000)
    env.reset(seed=4)
    records, over = [env.record], False
    while not over:
        _, _, _, over, _ = env.step(np.array([0.2 * (-1.0) ** len(records)]))
        records.append(env.record)
    return Log(concatenate(records), env.slow_sensors), env.nominal


def table_of_record(log: Log) -> Table:
    """The fast rows at the instants and the newest packet of each."""
    packets, rows = log.record.packets, []
    for tick in INSTANTS:
        newest = packets[packets[:, PACKET.arrived] <= tick][-1]
        rows.append([tick, *log.record.fast[tick], *newest])
    names = [f"packet_{i}" for i in range(packets.shape[1])]
    return ["tick", *Fast._fields, *names], np.array(rows)


def table_of_filter(name: str, sensor: str, log: Log, vehicle: Vehicle) -> Table:
    """States and standard deviations of a filter at the instants, the speed measured."""
    sensors = {sensor: log.slow[sensor]} if sensor else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnobservableWarning)
        estimator = make_estimator(name, vehicle=vehicle, sensors=sensors)
    found = estimator.run(log)
    names = ["tick", *found.names, *(f"std_{state}" for state in found.names)]
    return names, np.column_stack([INSTANTS, found.x[INSTANTS], found.std[INSTANTS]])


def path(name: str, sensor: str = "") -> Path:
    return FOLDER / f"{name}{'-' if sensor else ''}{sensor}.csv"


def read(file: Path) -> Table:
    with file.open(newline="") as lines:
        names, *rows = csv.reader(lines)
    return names, np.array(rows, np.float64)


def write(file: Path, table: Table) -> None:
    names, rows = table
    lines = [",".join(names)]
    lines += [",".join(f"{value:.{DIGITS}g}" for value in row) for row in rows]
    file.write_text("\n".join(lines) + "\n")


def changes(old: Table, new: Table) -> np.ndarray:
    """By how much each number changed, as a share of its column's range; rows as in the tables."""
    scale = np.maximum(np.abs(old[1]).max(0), 1e-300)
    return np.asarray(np.abs(new[1] - old[1]) / scale)


def record_anew() -> None:
    """Replace the tables that changed, drop those of filters that are no more."""
    log, vehicle = drive()
    tables = {path("record"): table_of_record(log)}
    for case in CASES:
        tables[path(*case)] = table_of_filter(*case, log, vehicle)
    for gone in set(FOLDER.glob("*.csv")) - set(tables):
        gone.unlink()
    for file, table in tables.items():
        old = read(file) if file.exists() else ([], np.zeros((0, 0)))
        if old[0] != table[0] or not changes(old, table).max() <= TOLERANCE:
            write(file, table)
            print(f"recorded {file.name}")
