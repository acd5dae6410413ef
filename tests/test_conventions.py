"""What a machine can check of CONVENTIONS.md: numbers in pyproject.toml that may only fall.

`[tool.sideslip.conventions]` counts what breaks a rule, `[tool.sideslip.budget]` limits the lines
of each room. A change that lowers a number writes it there; nothing raises one but a commit that
says why.
"""

import ast
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
TABLES: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["sideslip"]
FLOORS = ("envs", "estimators", "agents", "benchmarks")
SLACK = 0.05  # the share by which a number may lie above today's before it has to be lowered
MOST_FILES, MOST_PARAMETERS = 11, 7
_BANNED = """
each found there those own mine ours theirs most least who told seen begun given kept ahead
alone together
"""
BANNED = frozenset(_BANNED.split())
STORED = frozenset(["ahead"])  # a key of users' camera files
_VERBS = """
accept accumulate adapt add advance advertise align allocate annotate append apply ask assemble
assert audit average begin bind bound build calibrate call capture carry change check choose
clear clip clone close collect combine compare compile complete compose compute concatenate
condense condition configure convert copy correct count create decode delay derive describe
design detach detect discretise distil distill download draw drive drop emulate encode end
ensure equalise estimate evaluate execute expand explain export extend extract factor fail feed
fetch fill filter find finish fit follow forget format from gather generate get give group guard
handle has hash identify import index infer inflate init initialise inline insert integrate
interpolate invert is iterate join keep label latch launch learn lend limit linearise list load
locate log look lower make map mark mask match measure merge minimise mirror mix monitor move
multiply name normalise note notice observe open optimise pack pad parse pass pick place plan
plot precompute predict prepare print process profile project propagate prune push put raise
rank read receive record reduce refuse register reject release remember remove render repeat
replace replay report require resample reset resolve restart restore return rewind rotate round
run sample save scale score search select send serve set settle shift show shrink shuffle
simulate skip smooth solve sort split square stack start step stop store subtract sum summarise
sweep symmetrise take teach test to track train transform transpose trim truncate trust try tune
turn unify unpack unroll update upload use validate vary visit wait walk warm warn watch whiten
wrap write
"""
VERBS = frozenset(_VERBS.split())
_ENDINGS = """
above after alone apart around as at before behind below beside beyond by for from in into of on
out over through to under until with within without
"""
ENDINGS = frozenset(_ENDINGS.split())
PARTICIPLE = re.compile(r"(ed|aid|ept|old|ost|ound|iven|awn|own|een|ung|uilt|ade)$")
Trees = dict[str, ast.Module]


def read_trees() -> Trees:
    """The syntax trees of the package's files by name."""
    paths = [path for floor in FLOORS for path in sorted((ROOT / floor).rglob("*.py"))]
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in paths}


def walk(trees: Trees, *kinds: type) -> Iterator[Any]:
    """Every node of some kinds."""
    for tree in trees.values():
        yield from (node for node in ast.walk(tree) if isinstance(node, kinds))


def find_functions(trees: Trees) -> Iterator[ast.FunctionDef]:
    """Functions and methods whose names are chosen freely: no magic ones, no properties."""
    for node in walk(trees, ast.FunctionDef):
        is_property = any("property" in ast.unparse(each) for each in node.decorator_list)
        if not node.name.startswith("__") and not is_property and node.name.strip("_"):
            yield node


def list_parameters(node: ast.FunctionDef) -> list[str]:
    """The names of a function's parameters without self and cls."""
    each = node.args
    names = [x.arg for x in (*each.posonlyargs, *each.args, each.vararg, *each.kwonlyargs) if x]
    names += [each.kwarg.arg] if each.kwarg else []
    return [name for name in names if name not in ("self", "cls")]


def count_excess_files(trees: Trees) -> int:
    """Files of rooms beyond the most that a room may have; a face is none."""
    rooms = Counter(name.rpartition("/")[0] for name in trees if not name.endswith("__init__.py"))
    return sum(max(count - MOST_FILES, 0) for count in rooms.values())


def count_colliding_classes(trees: Trees) -> int:
    """Names that several classes have; as in Gymnasium, a wrapper's is its vector twin's too."""
    twins = {name: tree for name, tree in trees.items() if name.startswith("estimators/vector/")}
    names = Counter(node.name for node in walk(trees, ast.ClassDef))
    names -= Counter(
        node.name for node in walk(twins, ast.ClassDef) if node.name.endswith("Observation")
    )
    return sum(count > 1 for count in names.values())


def count_banned_identifiers(trees: Trees) -> int:
    """Places that bind a banned word."""
    bound = [node.id for node in walk(trees, ast.Name) if isinstance(node.ctx, ast.Store)]
    bound += [node.attr for node in walk(trees, ast.Attribute) if isinstance(node.ctx, ast.Store)]
    bound += [node.arg for node in walk(trees, ast.arg)]
    bound += [node.name for node in walk(trees, ast.FunctionDef, ast.ClassDef)]
    return sum(name.strip("_").lower() in BANNED - STORED for name in bound)


def count_odd_endings(trees: Trees) -> int:
    """Functions that end in a preposition, or are a participle."""
    words = [node.name.strip("_").split("_") for node in find_functions(trees)]
    return sum(
        each[-1] in ENDINGS
        or (bool(PARTICIPLE.search(each[0])) and each[0] not in VERBS and len(each) <= 2)
        for each in words
    )


def count_verbless_functions(trees: Trees) -> int:
    """Functions that begin with no verb."""
    return sum(node.name.strip("_").split("_")[0] not in VERBS for node in find_functions(trees))


def list_options(trees: Trees) -> set[str]:
    """Annotations that carry a help text: typer's options and arguments, and names for them."""
    named = {ast.unparse(node.targets[0]): node.value for node in walk(trees, ast.Assign)}
    texts = {name for name, value in named.items() if "help=" in ast.unparse(value)}
    arguments = [node.annotation for node in walk(trees, ast.arg) if node.annotation]
    return texts | {text for each in arguments if "help=" in (text := ast.unparse(each))}


def list_entries(text: str | None) -> set[str]:
    """The names under `Args` of a docstring."""
    entries = (text or "").partition("Args:\n")[2]
    return set(re.findall(r"^ {4,}\*{0,2}(\w+)(?: \(.*?\))?:", entries, re.M))


def count_undocumented_arguments(trees: Trees) -> int:
    """Arguments of public functions, methods and constructors without an entry under `Args`.

    An option of a command has its help text instead, and what the functions of a file or of a room
    share stands under `Args` of the file or of the room's face.
    """
    count, options = 0, list_options(trees)
    for name, tree in trees.items():
        face = trees.get(f"{name.rpartition('/')[0]}/__init__.py", ast.parse(""))
        shared = list_entries(ast.get_docstring(face)) | list_entries(ast.get_docstring(tree))
        public = [(node, "") for node in tree.body]
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                public += [(each, ast.get_docstring(node) or "") for each in node.body]
        for node, above in public:
            if isinstance(node, ast.FunctionDef) and (
                node.name == "__init__" or not node.name.startswith("_")
            ):
                text = above if node.name == "__init__" else ast.get_docstring(node) or ""
                documented = shared | list_entries(text)
                documented |= {
                    each.arg
                    for each in ast.walk(node)
                    if isinstance(each, ast.arg)
                    and each.annotation
                    and ast.unparse(each.annotation) in options
                }
                count += len({*list_parameters(node)} - documented)
    return count


def count_long_signatures(trees: Trees) -> int:
    """Functions with more parameters than one can read."""
    functions = walk(trees, ast.FunctionDef)
    return sum(len(list_parameters(node)) > MOST_PARAMETERS for node in functions)


def count_any(trees: Trees) -> int:
    """Places that say `Any`; of an alias, its definition."""
    return sum(node.id == "Any" for node in walk(trees, ast.Name))


COUNTS: dict[str, Callable[[Trees], int]] = {
    "excess-files": count_excess_files,
    "colliding-classes": count_colliding_classes,
    "banned-identifiers": count_banned_identifiers,
    "odd-endings": count_odd_endings,
    "verbless-functions": count_verbless_functions,
    "undocumented-arguments": count_undocumented_arguments,
    "long-signatures": count_long_signatures,
    "any": count_any,
}
PLANTED = """
from typing import Any
Pair = tuple[Any, Any]
class Twin: pass
class Twin:
    def __init__(self, a, b):
        pass
    @property
    def mean(self): pass
def compute_mean(a, b=0, *rest, **more):
    '''Compute it.

    Args:
        a: One.
        **more: Others.
    '''
    found = a
def compute_all(a, b, c, d, e, f, g, h): '''Compute it.'''
def x_of(a): pass
def driven(shared): pass
def lqr(): pass
def _hidden_at(each): pass
def make_car(out: Annotated[str, Option(help="The file.")], into: Annotated[str, Option()]): pass
"""
EXPECTED = {
    "excess-files": 1,
    "colliding-classes": 1,
    "banned-identifiers": 2,
    "odd-endings": 3,
    "verbless-functions": 4,
    "undocumented-arguments": 14,
    "long-signatures": 1,
    "any": 2,
}


@pytest.fixture(scope="module")
def trees() -> Trees:
    return read_trees()


@pytest.mark.parametrize("name", COUNTS)
def test_what_breaks_a_rule_becomes_less(name: str, trees: Trees) -> None:
    now, kept = COUNTS[name](trees), TABLES["conventions"][name]
    assert now <= kept, f"{name} was {kept} and is {now}: CONVENTIONS.md says what to do instead"
    assert kept - now <= SLACK * kept, f"{name} is {now}: write it into pyproject.toml, not {kept}"


def test_every_count_has_its_number() -> None:
    assert TABLES["conventions"].keys() == COUNTS.keys()


def test_no_room_outgrows_its_budget(trees: Trees) -> None:
    lines = Counter[str]()
    for name in trees:
        lines[name.rpartition("/")[0]] += (ROOT / name).read_text().count("\n")
    budget = TABLES["budget"]
    assert budget.keys() == lines.keys(), "each room has a budget, in lines"
    assert {room: count for room, count in lines.items() if count > budget[room]} == {}


@pytest.mark.parametrize("name", COUNTS)
def test_a_count_finds_what_it_is_for(name: str) -> None:
    tree = ast.parse(PLANTED)
    face = ast.parse("'''A room.\n\nArgs:\n    shared: By all.\n'''")
    trees = {f"room/{i}.py": ast.parse("") for i in range(MOST_FILES)}
    trees |= {"room/planted.py": tree, "room/__init__.py": face}
    assert COUNTS[name](trees) == EXPECTED[name]
