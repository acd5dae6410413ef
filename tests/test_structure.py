"""The house: small files in small rooms, faces that say what lives there, tests that mirror it."""

import ast
import re
from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = ("envs", "estimators", "agents", "benchmarks")
SOURCES = [path for floor in FLOORS for path in sorted((ROOT / floor).rglob("*.py"))]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
FACES = [path for path in SOURCES if path.name == "__init__.py"]
MOST_LINES, MOST_MODULES = 450, 11


def name(path: Path) -> str:
    """As people write it."""
    return path.relative_to(ROOT).as_posix()


def test_no_file_is_longer_than_450_lines() -> None:
    lines = {name(path): path.read_text().count("\n") for path in (*SOURCES, *TESTS)}
    assert len(lines) > 250
    assert {path: count for path, count in lines.items() if count > MOST_LINES} == {}


def test_no_room_has_more_than_thirteen_modules() -> None:
    modules = Counter(name(path.parent) for path in SOURCES if path not in FACES)
    assert {room: count for room, count in modules.items() if count > MOST_MODULES} == {}
    assert set(modules) <= {name(face.parent) for face in FACES}  # every room has a face


@pytest.mark.parametrize("face", FACES, ids=name)
def test_every_rooms_face_says_what_lives_there(face: Path) -> None:
    text = ast.get_docstring(ast.parse(face.read_text())) or ""
    first, *_ = text.split("\n")
    assert len(text.split()) >= 6, "say what the room holds, in the field's words"
    assert first.endswith((".", "?")) or text.split("\n\n")[0].endswith((".", "?"))


def known(room: Path) -> set[str]:
    """The names of a room: modules, functions, classes, variables; and its neighbours'."""
    names = {path.stem for path in (*room.parent.iterdir(), *room.rglob("*"))}
    for path in room.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.alias):
                names.add((node.asname or node.name).rpartition(".")[2])
            elif isinstance(node, ast.Name):
                names.add(node.id)
    return names


@pytest.mark.parametrize("face", FACES, ids=name)
def test_a_face_names_what_is_there(face: Path) -> None:
    text = ast.get_docstring(ast.parse(face.read_text())) or ""
    named = {part for words in re.findall(r"`([\w.]+)`", text) for part in words.split(".")}
    floor = face.relative_to(ROOT).parts[0]
    assert named <= known(face.parent) | set(import_module(f"sideslip.{floor}").__dict__)


def test_tests_mirror_the_rooms() -> None:
    """tests/envs/sensors/ holds the tests of envs/sensors/, or of a module of that name."""
    for path in TESTS:
        place = path.parent.relative_to(ROOT / "tests")
        if path.name.startswith("test_") and place.parts[:1] and place.parts[0] in FLOORS:
            room = ROOT / place
            assert room.is_dir() or room.with_suffix(".py").is_file(), name(path)
