"""`sideslip replay` and `sideslip identify`: recorded drives through estimators, and their car."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from ..harness.parallel import use_shared_bar
from ..report.terminal import print_suite
from .names import complete
from .options import parse_option, parse_options
from .output import check_files, print_written, write_output

Texts = list[str] | None
Drive = Annotated[
    Path, typer.Argument(help="A recorded drive: CSV, Parquet, MATLAB (.mat) or MDF (.mf4).")
]
Mapping = Annotated[
    Texts, typer.Option("--map", help="NAME_UNIT=COLUMN of the log (yaw_rate_degps=r); repeatable.")
]
Ratio = Annotated[
    float | None, typer.Option(help="Of the logged steering to the wheels' angle (15.2).")
]
Sign = Annotated[int | None, typer.Option(help="1 or -1, of the logged steering.")]
Offset = Annotated[float | None, typer.Option(help="deg at the wheels, added to the steering.")]


def _read_wires(vehicle: str | None, latency: Texts, **steering: float | None) -> Any:
    """What the vehicle's file has of the wires, and over it what was asked for."""
    from ..recorded.wires import read_wires

    known = read_wires(vehicle)
    overrides: dict[str, Any] = {
        name: value for name, value in steering.items() if value is not None
    }
    late = {**known.latency, **parse_options(latency)}
    return known._replace(latency=late, **overrides).check()


def parse_estimator_options(texts: Texts) -> dict[str, dict[str, Any]]:
    """{"joint": {"members": 4}} from texts such as "joint.members=4"; ValueError for others."""
    options: dict[str, dict[str, Any]] = {}
    for text in texts or ():
        key, value = parse_option(text)
        name, dot, option = key.partition(".")
        if not (name and dot and option):
            raise ValueError(f"an estimator's option is ESTIMATOR.NAME=VALUE, got {text!r}")
        options.setdefault(name, {})[option] = value
    return options


def replay_command(
    log: Annotated[
        Path, typer.Argument(help="A recorded drive: CSV, Parquet, MATLAB, MDF or NMEA.")
    ],
    vehicle: Annotated[
        str | None,
        typer.Option(
            help="A name, a TOML or JSON file, or `identify`: found in the log itself.",
            autocompletion=complete("vehicles"),
        ),
    ] = None,
    nominal: Annotated[
        str, typer.Option(help="The car whose mass and arms `--vehicle identify` takes.")
    ] = "passenger-car",
    mapping: Mapping = None,
    estimator: Annotated[
        Texts, typer.Option(help="A name; repeatable; default: all that the log serves.")
    ] = None,
    estimator_option: Annotated[
        Texts, typer.Option(help="ESTIMATOR.NAME=VALUE (joint.gate=0.99); repeatable.")
    ] = None,
    steering_ratio: Ratio = None,
    steering_sign: Sign = None,
    steering_offset: Offset = None,
    latency: Annotated[
        Texts, typer.Option(help="CHANNEL=S, by which a channel is late (gps=0.2); repeatable.")
    ] = None,
    until: Annotated[
        float | None,
        typer.Option(help="s of the log from which `identify` is; the rest is replayed."),
    ] = None,
    course_rate: Annotated[float, typer.Option(help="Hz of the emulated course.")] = 10.0,
    course_noise: Annotated[float, typer.Option(help="deg, standard deviation.")] = 0.5,
    course_delay: Annotated[float, typer.Option(help="s the course arrives late.")] = 0.0,
    course_bias: Annotated[float, typer.Option(help="deg.")] = 0.0,
    gyro_bias: Annotated[float, typer.Option(help="deg/s added to the gyro.")] = 0.0,
    html: Annotated[
        Path | None, typer.Option("--html", help="Write a self-contained report.")
    ] = None,
    json: Annotated[Path | None, typer.Option("--json", help="Write the rows as JSON.")] = None,
    parquet: Annotated[
        Path | None, typer.Option("--parquet", help="Write the rows as Parquet.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="Draw a receiver's track: PNG, PDF, SVG.")
    ] = None,
    kml: Annotated[Path | None, typer.Option(help="Write a receiver's track for a map.")] = None,
) -> None:
    """Run the estimators over a recorded drive and score them; over a receiver's log (NMEA), which
    has no gyro, filter the fixes with noise that follows HDOP or does not."""
    from ...envs.recordings.sources import is_nmea
    from ..recorded.replay_file import replay_file

    console = Console()
    check_files(html=html, json=json, parquet=parquet, plot=plot, kml=kml)
    if is_nmea(log):
        from ..recorded.receiver_suite import draw, make_receiver_suite, replay_nmea, write_kml

        with use_shared_bar(console, f"replay {log}"):
            received = replay_nmea(log, vehicle, mapping)
        write_output(console, [make_receiver_suite(received)], html, json, parquet)
        for path, write in ((plot, draw), (kml, write_kml)):
            if path is not None:
                write(path, received)
                print_written(console, path)
        return
    if plot or kml:
        raise ValueError(f"{log}: --plot and --kml are for a receiver's log (NMEA); see --html")
    offset = None if steering_offset is None else math.radians(steering_offset)
    wires = _read_wires(vehicle, latency, ratio=steering_ratio, sign=steering_sign, offset=offset)
    with use_shared_bar(console, f"replay {log}"):
        suite = replay_file(
            log,
            vehicle,
            mapping=mapping,
            wires=wires,
            nominal=nominal,
            until=until,
            estimators=estimator,
            options=parse_estimator_options(estimator_option),
            course_rate=course_rate,
            course_noise_deg=course_noise,
            delay=course_delay,
            bias_deg=course_bias,
            gyro_bias_degps=gyro_bias,
        )
    write_output(console, [suite], html, json, parquet)


def identify_command(
    log: Drive,
    vehicle: Annotated[
        str,
        typer.Option(
            help="The car that is stated: its mass and arms stay, the search starts there.",
            autocompletion=complete("vehicles"),
        ),
    ] = "passenger-car",
    mapping: Mapping = None,
    out: Annotated[Path | None, typer.Option(help="Write the car and its wires as TOML.")] = None,
    until: Annotated[
        float | None, typer.Option(help="s of the log that are used; the rest stays fresh.")
    ] = None,
    tyres: Annotated[
        str | None,
        typer.Option(
            help="linear: as stiff as in this drive; fiala: as at small slips; default: "
            "what predicts better."
        ),
    ] = None,
    steering_ratio: Ratio = None,
    steering_sign: Sign = None,
    steering_offset: Offset = None,
) -> None:
    """Find a car's stiffness, inertia, steering, noise and latencies in a recorded drive, with
    intervals, and which of them the log cannot tell; exit status 1, and no file, where nothing is
    identified."""
    from ..recorded.replay_file import identify_file
    from ..recorded.wires import write_vehicle

    console = Console()
    check_files(toml=out)
    offset = None if steering_offset is None else math.radians(steering_offset)
    wires = _read_wires(vehicle, None, ratio=steering_ratio, sign=steering_sign, offset=offset)
    with use_shared_bar(console, f"identify {log}"):
        result, suite = identify_file(log, vehicle, mapping or (), wires, tyres, until)
    print_suite(console, suite)
    if result.reason:
        raise typer.Exit(1)
    if out is not None:
        write_vehicle(out, result.car, result.wires)
        print_written(console, out)
