"""Is a renamed and moved tree the same code? Every function, class and statement is compared.

`python tests/bits/same_code.py OLD_TREE NEW_TREE renames.csv [moves.csv]`. renames.csv has the
columns file, old, new: a file of the old tree, a module-level name or `Class.member`, and the later
name without the class. moves.csv has the columns old, new: files. What differs is printed, and the
exit status is then 1.

Global names are followed through imports to their definitions: a call of another function with the
same name differs. Locals and arguments count by their place. Keywords follow arguments and members,
attributes follow members. Strings are never mapped: each changed one is printed. Docstrings,
imports and the order of definitions do not count.
"""

import ast
import csv
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

PACKAGE = "sideslip"
SKIPPED = {"src", ".venv", "dist", "build", "_build"}
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
SCOPES = (*DEFINITIONS, ast.Lambda, *COMPREHENSIONS)
KINDS = {ast.Attribute: "attribute", ast.keyword: "keyword", ast.arg: "argument"}
NO_CODE = {"ctx", "type_comment", "kind", "type_params"}
Key = tuple[str, str]  # file, name


class Token(NamedTuple):
    kind: str  # code, string, attribute, keyword or argument
    value: Any


class Unit(NamedTuple):
    """A function, a class without its methods, or a statement. key: its later file and name."""

    key: Key
    old: str
    origin: str
    tokens: list[Token]


def is_left_out(node: ast.AST) -> bool:
    """Whether a statement does not count: imports, texts, conditions that only import."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return isinstance(node.value.value, str)
    if isinstance(node, ast.If):
        return all(map(is_left_out, [*node.body, *node.orelse]))
    return isinstance(node, ast.Import | ast.ImportFrom | ast.Pass)


def walk_scope(nodes: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Everything in some nodes that is in no scope below theirs, the definitions included."""
    for node in nodes:
        yield node
        if isinstance(node, SCOPES):
            yield from (each.target for each in ast.walk(node) if isinstance(each, ast.NamedExpr))
        else:
            yield from walk_scope(ast.iter_child_nodes(node))


def bound_names(nodes: Iterable[ast.AST]) -> set[str]:
    """The names that some nodes bind in their scope, but for imports."""
    bound, outer = set[Any](), set[str]()
    for node in walk_scope(nodes):
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            bound.add(node.id)
        elif isinstance(node, ast.Global | ast.Nonlocal):
            outer.update(node.names)
        elif isinstance(node, (*DEFINITIONS, ast.ExceptHandler)):
            bound.add(node.name)
    return bound - outer - {None}


def imported_names(nodes: Iterable[ast.AST], file: str) -> dict[str, Key]:
    found = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                path = alias.name if alias.asname else alias.name.partition(".")[0]
                found[alias.asname or path] = (path, "")
        elif isinstance(node, ast.ImportFrom):
            room = [PACKAGE, *file.split("/")[:-1]]
            base = room[: len(room) + 1 - node.level] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            found |= {alias.asname or alias.name: (module, alias.name) for alias in node.names}
    return found


class Tree:
    """The Python files of a folder. renames, moves: what its names and files are called later."""

    def __init__(self, root: Path, renames: dict[Key, str], moves: dict[str, str]) -> None:
        self.renames, self.moves = renames, moves
        self.files = {
            path.relative_to(root).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
            for path in sorted(root.rglob("*.py"))
            if not {*path.relative_to(root).parts} & SKIPPED
        }
        self.names = {x: bound_names(tree.body) for x, tree in self.files.items()}
        self.imports = {x: imported_names(walk_scope(y.body), x) for x, y in self.files.items()}

    def find_import(self, module: str, name: str) -> Any:
        """What an import names: a file of here, the `Key` of a definition, a path of others."""
        first, *parts = module.split(".")
        stem, found = "/".join(parts), module
        for file in (f"{stem}.py", f"{stem}/__init__.py".lstrip("/")):
            if first == PACKAGE and file in self.files:
                found = file
        return self.find_member(found, name) if name else found

    def find_member(self, found: Any, name: str) -> Any:
        """An attribute of a module; None of something else."""
        if not isinstance(found, str) or found not in self.files:
            return f"{found}.{name}" if isinstance(found, str) else None
        if name in self.names[found]:
            return (found, name)
        module, member = self.imports[found].get(name, ("", ""))
        if module and (not member or self.find_import(module, "") != found):
            return self.find_import(module, member)
        room = found.removesuffix("__init__.py")
        below = [x for x in (f"{room}{name}.py", f"{room}{name}/__init__.py") if x in self.files]
        return below[0] if below else (found, name)

    def find_later(self, found: Any) -> Any:
        if isinstance(found, str):
            return self.moves.get(found, found)
        return (self.moves.get(found[0], found[0]), self.renames.get(found, found[1]))

    def units(self, nodes: Any = None, file: str = "", owner: str = "") -> Iterator[Unit]:
        if not file:
            for each, tree in self.files.items():
                yield from self.units(tree.body, each)
        for node in nodes or ():
            if is_left_out(node):
                continue
            target = (getattr(node, "targets", None) or [getattr(node, "target", None)])[0]
            name: str = getattr(node, "name", "") or getattr(target, "id", "")
            whole = f"{owner}.{name}" if owner else name
            above = f"{self.renames.get((file, owner), owner)}." if owner else ""
            key = (self.moves.get(file, file), above + self.renames.get((file, whole), name))
            body, inside, origin = [node], owner, f"{file}:{node.lineno} {whole}"
            if isinstance(node, ast.ClassDef):
                methods = [each for each in node.body if isinstance(each, DEFINITIONS)]
                yield from self.units(methods, file, whole)
                fields = [each for each in node.body if each not in methods]
                body = [*node.decorator_list, *node.bases, *node.keywords, *fields]
                inside = whole
            yield Unit(
                key, whole, origin, Writer(self, file, inside, bound_names(body)).write(body)
            )


class Writer:
    """Writes code as tokens. members: the names of the class `owner` if it is one's body."""

    def __init__(self, tree: Tree, file: str, owner: str, members: set[str]) -> None:
        self.tree, self.file, self.owner = tree, file, owner
        self.members = members if owner else set()
        self.scopes: list[dict[str, int]] = []
        self.imports, self.tokens, self.locals = dict(tree.imports[file]), list[Token](), 0

    def write(self, nodes: Iterable[Any]) -> list[Token]:
        """Add what counts of some nodes; return all tokens."""
        kept = [each for each in nodes if not (isinstance(each, ast.AST) and is_left_out(each))]
        self.put(len(kept))
        for each in kept:
            self.write_field(each)
        return self.tokens

    def put(self, value: Any, kind: str = "code") -> None:
        self.tokens.append(Token(kind, value))

    def write_field(self, value: Any) -> None:
        if isinstance(value, list):
            self.write(value)
        elif isinstance(value, ast.AST):
            self.visit(value)
        else:
            self.write_name(value) if isinstance(value, str) else self.put(repr(value))

    def write_name(self, name: str) -> None:
        """Add a name: a local by its place, a member by its class, another by its definition."""
        for scope in reversed(self.scopes):
            if name in scope:
                self.locals += not scope[name]
                scope[name] = scope[name] or self.locals
                return self.put(scope[name])
        if not self.scopes and name in self.members:
            key = (self.file, f"{self.owner}.{name}")
            return self.put(self.tree.renames.get(key, name), "attribute")
        found = self.find(ast.Name(name)) or f"builtin {name}"
        if name == "__file__":  # where it lies counts, whatever it is called
            found = self.file.rpartition("/")[0]
        self.put(self.tree.find_later(found))

    def find(self, node: ast.AST) -> Any:
        """The module, or the definition in one, that an expression is; None for another."""
        if isinstance(node, ast.Attribute):
            return self.tree.find_member(self.find(node.value), node.attr)
        if not isinstance(node, ast.Name) or any(node.id in scope for scope in self.scopes):
            return None
        if node.id in self.tree.names[self.file]:
            return (self.file, node.id)
        return self.tree.find_import(*self.imports[node.id]) if node.id in self.imports else None

    def visit(self, node: Any) -> None:
        """Add a node: its type, its name, its fields; what it binds is local from here on."""
        found, is_scope = self.find(node), isinstance(node, SCOPES)
        if isinstance(node, ast.Name):
            return self.write_name(node.id)
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            return self.put(node.value, "string")
        if found is not None:
            return self.put(self.tree.find_later(found))
        self.put(type(node).__name__)
        fields = {name: each for name, each in ast.iter_fields(node) if name not in NO_CODE}
        if type(node) in KINDS:
            self.put(fields.pop("attr", None) or fields.pop("arg"), KINDS[type(node)])
        for note in {"annotation", "returns"} & fields.keys():
            if isinstance(fields[note], ast.Constant) and isinstance(fields[note].value, str):
                fields[note] = ast.parse(fields[note].value, mode="eval").body
        if isinstance(node, DEFINITIONS):
            self.write_name(fields.pop("name"))
        if is_scope:
            inside: Any = fields.get("generators", fields.get("body"))
            names = bound_names(inside if isinstance(inside, list) else [inside])
            if "args" in fields:
                names |= {each.arg for each in ast.walk(node.args) if isinstance(each, ast.arg)}
                self.imports |= imported_names(ast.walk(node), self.file)
            self.scopes.append(dict.fromkeys(names, 0))
        elif isinstance(node, ast.arg):
            self.write_name(node.arg)
        for each in fields.values():
            self.write_field(each)
        if is_scope:
            self.scopes.pop()


def compare(old: Tree, new: Tree) -> list[str]:
    before, after = dict[Key, list[Unit]](), dict[Key, list[Unit]]()
    for tree, found in ((old, before), (new, after)):
        for unit in tree.units():
            found.setdefault(unit.key, []).append(unit)
    lines, pairs = list[str](), list[tuple[Unit, Unit]]()
    for key in {**before, **after}:
        mine, theirs = before.get(key, []), after.get(key, [])
        if key[1] and len({(unit.origin.split(":")[0], unit.old) for unit in mine}) > 1:
            lines.append(f"{', '.join(x.origin for x in mine)}: one name for several, {key}")
        for unit in list(mine):
            twin = next((each for each in theirs if each.tokens == unit.tokens), None)
            if twin:
                mine.remove(unit)
                theirs.remove(twin)
        pairs += zip(mine, theirs, strict=False)
        lines += [f"{each.origin}: gone, expected as {key}" for each in mine[len(theirs) :]]
        lines += [f"{each.origin}: new" for each in theirs[len(mine) :]]
    later = defaultdict[str, set[str]](set)
    for (_, name), other in old.renames.items():
        later[name.rpartition(".")[2]].add(other)
    for x, y in (both for a, b in pairs for both in zip(a.tokens, b.tokens, strict=False)):
        if x.kind == y.kind == "argument":
            later[x.value].add(y.value)
    return lines + [line for a, b in pairs for line in find_differences(a, b, later)]


def find_differences(old: Unit, new: Unit, later: dict[str, set[str]]) -> Iterator[str]:
    """What differs between two units. later: the names that a member or argument may get."""
    for x, y in zip_longest(old.tokens, new.tokens, fillvalue=Token("code", "nothing")):
        if x != y and (x.kind != y.kind or x.kind == "code"):
            yield f"{old.origin} -> {new.origin}: {x.value} is now {y.value}, and what follows"
            return
        if x.value != y.value and (x.kind == "string" or y.value not in later[x.value]):
            yield f"{old.origin} -> {new.origin}: {x.kind} {x.value!r} is now {y.value!r}"


def main(old: Path, new: Path, renames: Path, moves: Path | None = None) -> int:
    """Print what differs, return the exit status; ValueError for rows that do not fit the tree."""
    table: dict[Key, str] = {}
    for row in csv.DictReader(renames.read_text(encoding="utf-8").splitlines()):
        if table.setdefault((row["file"], row["old"]), row["new"]) != row["new"]:
            raise ValueError(f"{row['file']}: {row['old']} has two new names")
    moved = csv.DictReader(moves.read_text(encoding="utf-8").splitlines() if moves else [])
    before = Tree(old, table, {row["old"]: row["new"] for row in moved})
    for file, name in table:
        if name.partition(".")[0] not in before.names.get(file, ()):
            raise ValueError(f"{file}: there is no {name} in the old tree")
    lines = compare(before, Tree(new, {}, {}))
    print(*lines, f"{len(lines)} differences", sep="\n")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:])))
