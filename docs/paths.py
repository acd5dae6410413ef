"""The pictures of ARCHITECTURE.md's paths, docs/_static/path-*.svg: `python docs/paths.py`."""

import ast
from html import escape
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]


class Step(NamedTuple):
    """A function on a path: its file, its name, what it does, and what it hands to the next."""

    file: str
    function: str
    does: str
    hands: str = ""


PATHS = {
    "action": (
        Step("envs/stability.py", "StabilityEnv.step", "checks the action's shape",
             "fractions of full scale, shape (1,) or (2,)"),
        Step("envs/engine/step.py", "step_episode",
             "clips or refuses it; integrate_step holds it for n ticks of 1 ms",
             "yaw moment N_z (N m) and added steering (rad)"),
        Step("envs/engine/tick.py", "integrate_tick",
             "adds driver, speed control, wind and road; calls the next two in turn",
             "yaw moment, drive force and limits of a tick"),
        Step("envs/vehicle/actuators.py", "allocate_torques",
             "splits N_z between two motors; rate limits, stops and lags are here too",
             "torques (N m) and angle (rad), by way of the tyres' TyreLoad"),
        Step("envs/vehicle/dynamics.py", "kutta3", "moves the car by Kutta's third-order rule"),
    ),
    "packet": (
        Step("estimators/wrappers/estimate.py", "EstimateObservation.step",
             "takes the step's record: fast rows, and packets that arrived",
             "StepRecord of the step: fast rows, packets, and how many of each"),
        Step("estimators/core/filter.py", "observe",
             "advances tick by tick to the arrival: predicts, and corrects by fast sensors",
             "packet, shape (PACKET_WIDTH,): captured and arrived tick, values"),
        Step("estimators/core/packets.py", "process_packet",
             "refuses what cannot be; rewinds, or finds the state as it was captured",
             "sample and the cloned or restored state"),
        Step("estimators/core/update.py", "update_filter",
             "forms the innovation, gates it unless gains are tabulated, corrects x and P"),
    ),
    "entry": (
        Step("benchmarks/cli/main.py", "_Bench.run", "reads the command line",
             "Request: seeds, processes, folder; to the study of that name in SUITES"),
        Step("benchmarks/control/suite.py", "_measure", "is the study: tasks, entries, seeds",
             "tasks, shape (T,)"),
        Step("benchmarks/control/entries.py", "make_cases",
             "lists who drives each task: Entry(agent, estimator)",
             "ControlCase: a task and an entry"),
        Step("benchmarks/control/run.py", "measure",
             "drives entry.make(task, n) in processes: n seeds at once, step by step",
             "DriveResult of each case: metrics, shape (seeds, len(NUMBERS))"),
        Step("benchmarks/control/score.py", "Matrix.overall",
             "pairs drives with nominal's on the same seed: r; ranks by the score, its mean"),
    ),
}  # fmt: skip
"""Steps by the picture's name."""

_WIDTH, _BOX, _GAP = 720, 58, 34  # px
_STYLE = """\
text { font: 15px sans-serif; fill: #1f2328 } .code { font: 14px monospace; font-weight: bold }
.hands { font-style: italic; fill: #59636e } rect { fill: #f6f8fa; stroke: #59636e }
path { stroke: #59636e; fill: #59636e }
@media (prefers-color-scheme: dark) { text { fill: #e6edf3 } .hands { fill: #9198a1 }
rect { fill: #161b22; stroke: #9198a1 } path { stroke: #9198a1; fill: #9198a1 } }"""


def draw_path(name: str) -> str:
    """Draw a path as SVG, box under box.

    Args:
        name: Key of `PATHS`.

    Returns:
        Text of the file.
    """
    steps, parts = PATHS[name], list[str]()
    for i, step in enumerate(steps):
        y = 1 + i * (_BOX + _GAP)
        parts += [
            f'<rect x="1" y="{y}" width="{_WIDTH - 2}" height="{_BOX}" rx="6"/>',
            f'<text class="code" x="14" y="{y + 23}">{step.file}: {step.function}</text>',
            f'<text x="14" y="{y + 46}">{escape(step.does)}</text>',
        ]
        if step.hands:
            end = y + _BOX + _GAP
            parts += [
                f'<path d="M30 {y + _BOX} V{end - 7} m-5 0 h10 l-5 7 z"/>',
                f'<text class="hands" x="46" y="{end - 12}">{escape(step.hands)}</text>',
            ]
    height = len(steps) * (_BOX + _GAP) - _GAP + 2
    size = f'width="{_WIDTH}" height="{height}" viewBox="0 0 {_WIDTH} {height}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>'
    return "\n".join([head, f"<style>{_STYLE}</style>", *parts, "</svg>", ""])


def find_names(file: str, function: str) -> set[str]:
    """Find the names that a module uses, ValueError without the function.

    Args:
        file: Module, from the root.
        function: Name of a function in it, or Class.method.

    Returns:
        Names and attributes.
    """
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    nodes: list[ast.AST] = [tree]
    for part in function.split("."):
        nodes = [x for node in nodes for x in ast.walk(node) if getattr(x, "name", "") == part]
    if not nodes:
        raise ValueError(f"{file} has no {function}")
    return {str(getattr(x, "id", getattr(x, "attr", ""))) for x in ast.walk(tree)}


if __name__ == "__main__":
    for name in PATHS:
        (ROOT / f"docs/_static/path-{name}.svg").write_text(draw_path(name), encoding="utf-8")
