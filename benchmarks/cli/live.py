"""`sideslip live`: an estimator on UDP datagrams in real time, the simulated car, relay, replay."""

import json
import os
import signal
import socket
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from time import monotonic
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.markup import escape

from ...envs.validation import check_choice
from ..harness.results import write_text
from ..report.study import format_verdict
from . import common
from .common import File, Text, Texts, register, take, take_argument
from .names import check_env

console = Console(soft_wrap=True, highlight=False)


@register("live", "Run an estimator on a car's wires.")
class _Live:
    """Run an estimator in real time on datagrams of a car's sensors, and an agent if asked to.

    With --simulate a simulated car is at the other end; without an ESTIMATOR it is alone.
    """

    estimator: Text = take_argument("A name, FILE.py:Class or module:Name.", kinds="estimators")
    agent: str = take("What answers with controls.", "none")
    env: Text = take("The id whose sensors the car has; default: one that fits.")
    vehicle: Text = take("The car: a name or a file.")
    scenario: Text = take("Of --simulate: a name or a file.")
    option: Texts = take("NAME=VALUE of the id; repeatable.")
    agent_option: Texts = take("NAME=VALUE; repeatable.")
    estimator_option: Texts = take("NAME=VALUE; repeatable.")
    seed: int = take("Of --simulate, and of drawn sensor phases.", 0)
    control_period: int | None
    host: str = take("Where port and page are bound.", "127.0.0.1")
    port: int = take("UDP port of what comes in.", 47001)
    publish: Texts = take("HOST:PORT that gets every estimate; repeatable.")
    gps: Text = take("NMEA: a file, serial:PORT[:BAUD] or tcp:HOST:PORT.")
    latency: float = take("s that the receiver is late.", 0.0)
    page: int | None = take("Port of a live page; 0: any.")
    simulate: bool = take("The other end: a simulated car.", False, "--simulate")
    relay: Text = take("Only relay this NMEA by UDP; as --gps.")
    to: Text = take("HOST:PORT for --relay, --simulate alone.")
    step: bool = take("Lock-step, as fast as it goes.", False, "--step")
    speed: float = take("Of --simulate and of a file.", 1.0, min=0.001)
    duration: float = take("s, after which it ends.", float("inf"))
    record: File = take("Write the session to a new file.")
    replay: File = take("Take a session again.")
    json: File = take("Write what was measured.", ends=".json")
    trust: bool

    def run(self) -> None:
        from ...agents.live.loop import LOOPBACK

        target = _parse_address(self.to) if self.to else (LOOPBACK, self.port)
        setup = common.make_setup(vars(self))
        if self.relay is not None:
            used = "relay to port latency speed duration json"
            common.refuse_unused_options(self, used, "--relay")
            self._relay(self.relay, target)
        elif self.replay is not None:
            common.refuse_unused_options(self, "replay estimator agent env json trust", "--replay")
            self._replay(self.replay, setup)
        elif self.estimator is not None:
            used = " ".join({*vars(self)} - {"to"})
            common.refuse_unused_options(self, used, "an ESTIMATOR: see --publish")
            self._run_loop(setup, [_parse_address(text) for text in self.publish or []])
        elif self.simulate:
            used = "simulate env vehicle scenario option control_period seed to port step speed"
            common.refuse_unused_options(self, used, "--simulate without an ESTIMATOR")
            self._simulate(setup, target)
        else:
            raise ValueError("name an ESTIMATOR, or --simulate, --relay or --replay")

    def _run_loop(self, setup: dict[str, Any], publish: list[Any]) -> None:
        """Run the loop with its connections, and print and write what it measured."""
        from ...agents.live.controller import OnboardController, Recorder
        from ...agents.live.loop import Loop, Port, Relay
        from ...agents.live.messages import PATIENCE, StreamSynchroniser
        from ...agents.live.peers import SimulatedCarProcess, Viewer

        patience = None if self.step else round(PATIENCE / min(self.speed, 1.0))
        with ExitStack() as stack:
            port = stack.enter_context(Port(self.host, self.port))
            onboard = OnboardController(*common.make_driver(setup, self.trust), setup["seed"])
            setup["env"] = onboard.base.spec.id
            loop = Loop(onboard, StreamSynchroniser(patience), port, publish, step=self.step)
            page = None if self.page is None else (self.host, self.page)
            if page is not None or console.is_terminal:
                title = f"{self.estimator}, {self.agent}"
                viewer = stack.enter_context(Viewer(title, page, console.is_terminal))
                loop.viewer = viewer.address
                if viewer.url:
                    console.print(f"page: {viewer.url}")
            other = None
            if self.simulate:
                arguments = setup["env"], setup["options"], port.address, setup["seed"]
                other = stack.enter_context(SimulatedCarProcess(*arguments, self.step, self.speed))
            signals = _watch_signals()
            relay = None
            if self.gps is not None:
                source = stack.enter_context(Port())
                relay = Relay(self.gps, source, port.address, self.latency, self.speed)
                Thread(target=relay.run, args=(lambda: bool(loop.ended),), daemon=True).start()
            if self.record is not None:  # last: where something is wrong before, no file is left
                loop.recorder = Recorder(self.record, setup | {"patience": patience})
                stack.callback(loop.recorder.close)
            console.print(f"listening on {port.address[0]}:{port.address[1]}")
            if other is not None:
                other.start_drive()
            loop.run(lambda: bool(signals), self.duration)
            drive = other.result() if other is not None and loop.assembler.over else None
        numbers = setup | loop.numbers() | {"load": os.getloadavg(), "cores": os.cpu_count()}
        lines = loop.lines(setup["estimator"])
        if relay is not None and relay.error:
            lines.append(f"The receiver was lost: {relay.error}")
        if drive is not None:
            lines.append(_compare_offline(drive, setup, self.trust, numbers))
        console.print(f"[bold]{escape(format_verdict(*lines))}[/]")
        common.print_written(console, self.record)
        self._write(numbers)

    def _simulate(self, setup: dict[str, Any], target: Any) -> None:
        from ...agents.live.loop import Port
        from ...agents.live.peers import simulate

        env_id = self.env or "sideslip/YawVision-v0"
        check_env(env_id)
        env = gym.make(env_id, **setup["options"])
        with Port() as port:
            drive, wires = simulate(env, port, target, self.seed, self.step, self.speed)
        common.show_episode(console, drive, "the other end")
        console.print(f"{wires.late} of {wires.periods} controls came a period late")

    def _relay(self, source: str, target: Any) -> None:
        """Send a receiver's sentences on, until the time is over."""
        from ...agents.live.loop import Port, Relay

        signals, end = _watch_signals(), monotonic() + self.duration
        with Port() as port:
            relay = Relay(source, port, target, self.latency, self.speed)
            relay.run(lambda: bool(signals) or monotonic() > end)
        for what, count in relay.counts.rows():
            console.print(f"{count:8d} {what}")
        console.print(f"{relay.sent} datagrams to {target[0]}:{target[1]}")
        self._write({"sent": relay.sent, "error": relay.error, **dict(relay.counts.rows())})
        if relay.error:
            raise OSError(relay.error)

    def _replay(self, path: Path, requested: dict[str, Any]) -> None:
        """Process a session again, and compare the estimates."""
        from ...agents import AGENTS
        from ...agents.learned.policy import check_names_no_code
        from ...agents.live.controller import OnboardController, read_setup, replay_session
        from ...estimators.filters import FILTERS

        setup = read_setup(path)
        for kind, known in (("estimator", FILTERS), ("agent", AGENTS)):
            if requested[kind] not in (None, "none", setup.get(kind)):
                raise ValueError(f"{path} is of {kind} {setup[kind]}, not {requested[kind]}")
            if setup.get(kind) != requested[kind]:  # a file's text may not choose what code is run
                name = f"{kind} in {path}, name it in the command to run it:"
                check_choice(name, setup[kind], known)
        unasked = "" if setup["env"] == requested["env"] else setup["env"]
        check_names_no_code(unasked, "", setup["estimator_options"])
        driver = common.make_driver(requested | setup, self.trust)
        onboard = OnboardController(*driver, setup["seed"])
        ticks, same = replay_session(path, onboard, setup["patience"])
        text = "those of the session bit for bit" if same else "NOT those of the session"
        console.print(f"{ticks} ticks; the estimates are {text}")
        self._write(setup | {"ticks": ticks, "same": same})

    def _write(self, numbers: Mapping[str, Any]) -> None:
        if self.json is not None:
            write_text(self.json, json.dumps(numbers, indent=1) + "\n")
            common.print_written(console, self.json)


def _parse_address(text: str) -> tuple[str, int]:
    """Parse HOST:PORT, or PORT of this machine, to an address of IPv4."""
    host, _, number = text.rpartition(":")
    if not (number.isascii() and number.isdigit() and 0 <= int(number) < 65536):
        raise ValueError(f"an address is HOST:PORT or PORT, got {text!r}")
    try:
        return socket.gethostbyname(host or "127.0.0.1"), int(number)
    except OSError as error:
        raise ValueError(f"{text!r} is no address of IPv4: {error}") from None


def _watch_signals() -> list[int]:
    signals: list[int] = []
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, lambda number, _: signals.append(number))
    return signals


def _compare_offline(
    drive: tuple[Any, int, int], setup: dict[str, Any], trust: bool, numbers: dict[str, Any]
) -> str:
    """Compare the drive with the same one without datagrams; a sentence, and new `numbers`."""
    from ...agents.rollout import rollout

    columns, late, periods = drive
    offline = rollout(*common.make_driver(setup, trust), setup["seed"]).columns
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
