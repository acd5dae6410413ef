"""The documents: their examples run, with the edits that they show; what they point to exists."""

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from ast import literal_eval
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

from sideslip.benchmarks.cli.main import app

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FLOORS = ("envs", "estimators", "agents", "benchmarks")
PLACE = re.compile(rf"`((?:{'|'.join((*FLOORS, 'tests', 'docs'))})/[\w/.-]*)`")
NAME = re.compile(r"`sideslip((?:\.\w+)+)")
LINK = re.compile(r"\]\((?!http)([^)#]+)")
FENCE = re.compile(r"^```(python|diff)(?: (\S+))?\n(.*?)^```$", re.DOTALL | re.MULTILINE)
MOST_FILES = {
    "sensor": 5,
    "tyre law": 2,
    "An action": 3,
    "cost term": 2,
    "filter": 1,
    "delay rule": 1,
    "controller": 2,
    "policy": 0,
    "network kind": 1,
    "scenario": 1,
    "metric": 2,
    "study": 2,
    "Bring your own": 0,
}
"""Files to edit for an extension."""


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_what_a_document_points_to_exists(document: Path) -> None:
    text = document.read_text()
    for place in PLACE.findall(text):
        assert (ROOT / place).exists(), place
    for target in LINK.findall(text):
        assert (document.parent / target).exists(), target
    for dotted in NAME.findall(text):
        found: Any = import_module("sideslip")
        path = "sideslip"
        for part in dotted.strip(".").split("."):
            path = f"{path}.{part}"
            if not hasattr(found, part):
                import_module(path)
            found = getattr(found, part)


def run(code: str, folder: Path, package: Path, **variables: str) -> str:
    """Run code in a fresh interpreter and an empty folder; `package` holds `sideslip`."""
    folder.mkdir()
    environment = os.environ | {"PYTHONPATH": str(package), "MPLBACKEND": "Agg"} | variables
    command = [sys.executable, "-W", "ignore", "-c", code]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.long
def test_readmes_example_runs(tmp_path: Path) -> None:
    """As a reader types it, and prints what README says."""
    text = (ROOT / "README.md").read_text()
    blocks = [code for kind, _, code in FENCE.findall(text)]
    assert len(blocks) == 1
    for line in run(blocks[0], tmp_path / "empty", ROOT / "src").splitlines():
        assert f"    {line}\n" in text


@pytest.mark.long
def test_the_slope_finds_tyres_and_gains(tmp_path: Path) -> None:
    """The page's own lines: 17 and 23 kN/rad behind noise, and nearly the cost of LQR's gains."""
    blocks = [
        code for _, _, code in FENCE.findall((ROOT / "docs" / "howto" / "gradients.md").read_text())
    ]
    tyres, costs = run("\n".join(blocks), tmp_path / "empty", ROOT / "src").splitlines()[-2:]
    assert literal_eval(tyres) == pytest.approx([17e3, 23e3], rel=0.02)
    start, found, lqr = literal_eval(costs)
    assert found < start - 0.3
    assert found == pytest.approx(lqr, abs=0.15)


EXTENDING = "".join(path.read_text() for path in DOCUMENTS if path.name == "EXTENDING.md")
PREAMBLE, *_SECTIONS = EXTENDING.split("\n## ")
SECTIONS = dict(section.split("\n", 1) for section in _SECTIONS)


@pytest.mark.long
@pytest.mark.parametrize("title", SECTIONS)
def test_an_extension_runs_in_a_copy_with_its_edits(title: str, tmp_path: Path) -> None:
    """Without the compiler, so that nothing is compiled for it, where it takes no minute then; the
    edits fit the files today."""
    package = tmp_path / "copy" / "sideslip"
    for floor in FLOORS:
        shutil.copytree(ROOT / floor, package / floor)  # bytecode too: an edited file's is stale
    for face in ("__init__.py", "__main__.py"):
        shutil.copy(ROOT / face, package)
    edited, code = set(), []
    for kind, place, text in FENCE.findall(PREAMBLE + SECTIONS[title]):
        if kind == "python":
            code.append(text)
        else:
            _, *parts = re.split(r"^\+\+\+ (\S+)\n", f"+++ {place}\n{text}", flags=re.MULTILINE)
            for file, diff in zip(parts[::2], parts[1::2], strict=True):
                edited.add(file)
                edit(package / file, diff)
    assert len(edited) <= MOST_FILES[title.removeprefix("A ")]
    assert code
    slow = title == "Bring your own"  # it drives six contestants
    run("\n".join(code), tmp_path / "empty", package.parent, NUMBA_DISABLE_JIT=str(int(not slow)))


def edit(path: Path, diff: str) -> None:
    """Apply a diff whose parts are divided by lines of @@; a new file is one part of + alone."""
    text = path.read_text() if path.exists() else ""
    for part in re.split(r"^@@.*\n", diff, flags=re.MULTILINE):
        lines = part.splitlines()
        old = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "+")
        new = "".join(f"{line[1:]}\n" for line in lines if line[:1] != "-")
        assert text.count(old) == 1 or not (old or text), f"{path.name} has no\n{old}"
        text = text.replace(old, new) if old else new
    path.write_text(text)


@pytest.mark.parametrize("name", ["action", "packet", "entry"])
def test_a_path_is_drawn_as_the_code_goes(name: str) -> None:
    """Each function is called by one before it, in at most five files, and none comes back."""
    paths = runpy.run_path(str(ROOT / "docs" / "paths.py"))
    steps = paths["PATHS"][name]
    assert len({step.file for step in steps}) == len(steps) <= 5
    called = {"step", "run", "_measure"}  # by agents, by the command line, by `Study.run`
    for step in steps:
        assert step.function.split(".")[-1] in called, f"who calls {step.function}?"
        called |= paths["find_names"](step.file, step.function)
    picture = (ROOT / "docs" / "_static" / f"path-{name}.svg").read_text()
    assert picture == paths["draw_path"](name), "run python docs/paths.py"


@pytest.mark.parametrize("name", ["blocks", "timing"])
def test_a_picture_is_what_its_script_draws(name: str) -> None:
    draw = runpy.run_path(str(ROOT / "docs" / "pictures.py"))["PICTURES"][name]
    assert (ROOT / f"docs/_static/{name}.svg").read_text() == draw(), "run python docs/pictures.py"


@pytest.mark.parametrize("module", ["", ".envs", ".estimators", ".agents"])
def test_a_page_names_every_public_name(module: str) -> None:
    text = "\n".join(path.read_text() for path in DOCUMENTS)
    for name in set(import_module(f"sideslip{module}").__all__) - {"__version__"}:
        assert re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text), f"{name} stands on no page"


COMMAND = re.compile(r"^ {4}(?:\S+=\S+ )*sideslip ((?:.*\\\n)*.*)$", re.MULTILINE)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_commands_and_their_options_exist(document: Path) -> None:
    for line in COMMAND.findall(document.read_text()):
        command: Any = typer.main.get_command(app)
        words = shlex.split(line.replace("\\\n", " ").replace("...", ""), comments=True)
        while words and hasattr(command, "commands"):
            if words[0].startswith("-"):
                break
            assert words[0] in command.commands, f"sideslip {line}"
            command = command.commands[words.pop(0)]
        known = {name for option in command.params for name in option.opts}
        options = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
        assert options <= known | {"--help"}, f"sideslip {line}: {options - known}"


TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
CELL = re.compile(r"^```\{code-cell\}\n(?::tags: \[(.*?)\]\n)?(.*?)^```$", re.DOTALL | re.MULTILINE)


@pytest.mark.long
@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_the_check_of_an_exercise_fails_without_an_answer(tutorial: Path, tmp_path: Path) -> None:
    """The documentation's build runs them with the hidden solution."""
    cells = CELL.findall(tutorial.read_text())
    tags = [set(tag.split(", ")) for tag, _ in cells]
    *before, check = [
        code for tag, (_, code) in zip(tags, cells, strict=True) if "solution" not in tag
    ]
    assert sum("solution" in tag for tag in tags) == 1 and "check" in tags[-1]
    code = (
        "\n".join(before)
        + f"\ntry:\n    exec({check!r})\nexcept AssertionError:\n    print('refused')"
    )
    assert run(code, tmp_path / "empty", ROOT / "src").splitlines()[-1] == "refused"
