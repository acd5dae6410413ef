"""`sideslip live`: an estimator on UDP datagrams in real time, the simulated car, relay, replay."""

import json as writer  # a command's option is called json
import os
import signal
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.markup import escape
from typer import Argument, Option

from ...envs.io import write_atomic
from ...envs.validation import check_choice
from ..harness.verdict import format_verdict
from .common import AgentSpec, check_files, parse_options, print_written, show_episode
from .names import File, Text, Texts, check_env, complete
from .policies import Trust

if TYPE_CHECKING:
    from ...agents.live.controller import OnboardController

console = Console(soft_wrap=True, highlight=False)


def live_command(
    estimator: Annotated[
        Text,
        Argument(
            help="A name, FILE.py:Class or module:Name.", autocompletion=complete("estimators")
        ),
    ] = None,
    agent: Annotated[str, Option(help="What answers with controls.")] = "none",
    env: Annotated[
        Text, Option(help="The id whose sensors the car has; default: one that fits.")
    ] = None,
    vehicle: Annotated[Text, Option(help="The car: a name or a file.")] = None,
    scenario: Annotated[Text, Option(help="Of --simulate: a name or a file.")] = None,
    option: Annotated[Texts, Option(help="NAME=VALUE of the id; repeatable.")] = None,
    agent_option: Annotated[Texts, Option(help="NAME=VALUE; repeatable.")] = None,
    estimator_option: Annotated[Texts, Option(help="NAME=VALUE; repeatable.")] = None,
    seed: Annotated[int, Option(help="Of --simulate, and of drawn sensor phases.")] = 0,
    control_period: Annotated[int, Option(help="Ticks of 1 ms.")] = 10,
    host: Annotated[str, Option(help="Where port and page are bound.")] = "127.0.0.1",
    port: Annotated[int, Option(help="UDP port of what comes in.")] = 47001,
    publish: Annotated[
        Texts, Option(help="HOST:PORT that gets every estimate; repeatable.")
    ] = None,
    gps: Annotated[Text, Option(help="NMEA: a file, serial:PORT[:BAUD] or tcp:HOST:PORT.")] = None,
    latency: Annotated[float, Option(help="s that the receiver is late.")] = 0.0,
    page: Annotated[int | None, Option(help="Port of a live page; 0: any.")] = None,
    simulate: Annotated[bool, Option("--simulate", help="The other end: a simulated car.")] = False,
    relay: Annotated[Text, Option(help="Only relay this NMEA by UDP; as --gps.")] = None,
    to: Annotated[Text, Option(help="HOST:PORT for --relay, --simulate alone.")] = None,
    step: Annotated[bool, Option("--step", help="Lock-step, as fast as it goes.")] = False,
    speed: Annotated[float, Option(min=0.001, help="Of --simulate and of a file.")] = 1.0,
    duration: Annotated[float, Option(help="s, after which it ends.")] = float("inf"),
    record: Annotated[File, Option(help="Write the session to a new file.")] = None,
    replay: Annotated[File, Option(help="Take a session again.")] = None,
    json: Annotated[File, Option("--json", help="Write what was measured.")] = None,
    trust: Trust = False,
) -> None:
    """Run an estimator in real time on datagrams of a car's sensors, and an agent if asked to.

    With --simulate a simulated car is at the other end; without an ESTIMATOR it is alone.
    """
    from ...agents.live.loop import LOOPBACK, parse_address

    check_files(json=json)
    target = parse_address(to) if to else (LOOPBACK, port)
    chosen = {"scenario": scenario, "vehicle": vehicle, "control_period": control_period}
    options = {name: value for name, value in chosen.items() if value is not None}
    setup: dict[str, Any] = {
        "estimator": estimator,
        "agent": agent,
        "env": env,
        "options": options | parse_options(option),
        "agent_options": parse_options(agent_option),
        "estimator_options": parse_options(estimator_option),
        "seed": seed,
    }
    if relay is not None:
        _run_relay(relay, target, latency, speed, duration, json)
    elif replay is not None:
        _replay(replay, setup, trust, json)
    elif estimator is not None:
        web = None if page is None else (host, page)
        subscribers = [parse_address(text) for text in publish or []]
        receiver = None if gps is None else (gps, latency)
        ends = _Connections((host, port), subscribers, web, receiver, simulate, speed, step, trust)
        _run_live(setup, ends, duration, record, json)
    elif simulate:
        _run_simulation(env or "sideslip/YawVision-v0", setup, target, step, speed)
    else:
        raise ValueError("name an ESTIMATOR, or --simulate, --relay or --replay")


@dataclass
class _Connections:
    """Ends of the loop. bound, page: host and port; receiver: its source and latency (s)."""

    bound: tuple[str, int]
    publish: list[Any]
    page: tuple[str, int] | None
    receiver: tuple[str, float] | None
    simulate: bool
    speed: float
    step: bool
    trust: bool


def _make_env_and_agent(setup: dict[str, Any], trust: bool) -> tuple[Any, Any]:
    names = setup["agent"], setup["agent_options"], setup["estimator"], setup["estimator_options"]
    return AgentSpec(*names, trust).build(setup["env"], setup["options"])


def _make_controller(setup: dict[str, Any], trust: bool) -> "OnboardController":
    from ...agents.live.controller import OnboardController

    return OnboardController(*_make_env_and_agent(setup, trust), setup["seed"])


def _watch_signals() -> list[int]:
    """Make a list that fills when the process is asked to end."""
    signals: list[int] = []
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, lambda number, _: signals.append(number))
    return signals


def _run_live(
    setup: dict[str, Any],
    ends: _Connections,
    duration: float,
    record: Path | None,
    json: Path | None,
) -> None:
    """Run the loop with its connections, and print and write what it measured."""
    from ...agents.live.controller import Recorder
    from ...agents.live.loop import Loop, Port
    from ...agents.live.messages import PATIENCE, StreamSynchroniser
    from ...agents.live.simulate import Relay, SimulatedCarProcess
    from ...agents.live.viewer import Viewer

    patience = None if ends.step else round(PATIENCE / min(ends.speed, 1.0))
    with ExitStack() as stack:
        port = stack.enter_context(Port(*ends.bound))
        onboard = _make_controller(setup, ends.trust)
        setup["env"] = onboard.base.spec.id
        loop = Loop(onboard, StreamSynchroniser(patience), port, ends.publish, step=ends.step)
        if ends.page is not None or console.is_terminal:
            title = f"{setup['estimator']}, {setup['agent']}"
            viewer = stack.enter_context(Viewer(title, ends.page, console.is_terminal))
            loop.viewer = viewer.address
            console.print(viewer.url and f"page: {viewer.url}")
        other = None
        if ends.simulate:
            arguments = setup["env"], setup["options"], port.address, setup["seed"]
            other = stack.enter_context(SimulatedCarProcess(*arguments, ends.step, ends.speed))
        signals = _watch_signals()
        relay = None
        if ends.receiver is not None:
            source, latency = ends.receiver
            relay = Relay(source, stack.enter_context(Port()), port.address, latency, ends.speed)
            Thread(target=relay.run, args=(lambda: bool(loop.ended),), daemon=True).start()
        if record is not None:  # last: where something is wrong before, no file is left
            loop.recorder = Recorder(record, setup | {"patience": patience})
            stack.callback(loop.recorder.close)
        console.print(f"listening on {port.address[0]}:{port.address[1]}")
        if other is not None:
            other.start_drive()
        loop.run(lambda: bool(signals), duration)
        drive = other.result() if other is not None and loop.assembler.over else None
    numbers = setup | loop.numbers() | {"load": os.getloadavg(), "cores": os.cpu_count()}
    lines = loop.lines(setup["estimator"])
    if relay is not None and relay.error:
        lines.append(f"The receiver was lost: {relay.error}")
    if drive is not None:
        lines.append(_compare_offline(drive, setup, ends.trust, numbers))
    console.print(f"[bold]{escape(format_verdict(*lines))}[/]")
    if record is not None:
        print_written(console, record)
    _write(json, numbers)


def _compare_offline(
    drive: tuple[Any, int, int], setup: dict[str, Any], trust: bool, numbers: dict[str, Any]
) -> str:
    """Compare the drive with the same one without datagrams; a sentence, and new `numbers`."""
    from ...agents.rollout import rollout

    columns, late, periods = drive
    offline = rollout(*_make_env_and_agent(setup, trust), setup["seed"]).columns
    same = all(np.array_equal(offline[name], values) for name, values in columns.items())
    rows = min(len(columns["beta"]), len(offline["beta"]))
    away = float(np.max(np.abs(columns["beta"][:rows] - offline["beta"][:rows])))
    numbers |= {"same": same, "late": late, "periods": periods, "beta_away": away}
    if same:
        return f"The drive is the offline one bit for bit; {late} of {periods} controls late."
    return (
        f"Beside the offline drive sideslip is {1e3 * away:.3g} mrad off at most: {late} of "
        f"{periods} controls came a period late."
    )


def _run_simulation(
    env_id: str, setup: dict[str, Any], target: Any, step: bool, speed: float
) -> None:
    """Run the simulated car alone and print its episode."""
    from ...agents.live.loop import Port
    from ...agents.live.simulate import simulate

    check_env(env_id)
    env, seed = gym.make(env_id, **setup["options"]), setup["seed"]
    with Port() as port:
        drive, wires = simulate(env, port, target, seed, step, speed)
    show_episode(console, drive, "the other end")
    console.print(f"{wires.late} of {wires.periods} controls came a period late")


def _run_relay(
    source: str, target: Any, latency: float, speed: float, duration: float, json: Path | None
) -> None:
    from ...agents.live.loop import Port
    from ...agents.live.simulate import Relay

    signals, end = _watch_signals(), monotonic() + duration
    with Port() as port:
        relay = Relay(source, port, target, latency, speed)
        relay.run(lambda: bool(signals) or monotonic() > end)
    for what, count in relay.counts.rows():
        console.print(f"{count:8d} {what}")
    console.print(f"{relay.sent} datagrams to {target[0]}:{target[1]}")
    _write(json, {"sent": relay.sent, "error": relay.error, **dict(relay.counts.rows())})
    if relay.error:
        raise OSError(relay.error)


def _replay(path: Path, requested: dict[str, Any], trust: bool, json: Path | None) -> None:
    from ...agents import AGENTS
    from ...agents.learned.policy import check_names_no_code
    from ...agents.live.controller import read_setup, replay
    from ...estimators.filters import FILTERS

    setup = read_setup(path)
    for kind, known in (("estimator", FILTERS), ("agent", AGENTS)):
        if setup.get(kind) != requested[kind]:  # a file's text may not choose what code is run
            check_choice(f"{kind} in {path}, name it in the command to run it:", setup[kind], known)
    unasked = "" if setup["env"] == requested["env"] else setup["env"]
    check_names_no_code(unasked, "", setup["estimator_options"])
    onboard = _make_controller(requested | setup, trust)
    session = replay(path, onboard, setup["patience"])
    same = "those of the session bit for bit" if session.same else "NOT those of the session"
    console.print(f"{len(session.ticks)} ticks; the estimates are {same}")
    _write(json, setup | {"ticks": len(session.ticks), "same": session.same})


def _write(path: Path | None, numbers: dict[str, Any]) -> None:
    if path is not None:
        write_atomic(path, (writer.dumps(numbers, indent=1) + "\n").encode())
        print_written(console, path)
