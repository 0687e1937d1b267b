"""How the package reads, in figures that may fall and must not rise: what packs several things into a statement.

A goal is that of code which its readers praise (gsplat, nerfstudio, torchtitan, equinox, measured the same
way) or near it. Not a target by itself: a statement that says two things hides one, and a number without a
reason can't be changed.
"""

import ast
import io
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

import fprf

ROOT = Path(fprf.__file__).parent
WIDE = 100
"""Characters of a line above which it is long."""
MOST_ARGUMENTS = 7


class Module(NamedTuple):
    name: str
    tree: ast.Module
    rows: list[str]

    def at(self, node: ast.AST, what: str = "") -> str:
        """Where a node stands, for the message of a test that fails."""
        return f"{self.name}:{getattr(node, 'lineno', 0)} {what}"


@cache
def modules() -> tuple[Module, ...]:
    found = []
    for file in sorted(ROOT.rglob("*.py")):
        text = file.read_text("utf-8")
        found.append(Module(str(file.relative_to(ROOT)), ast.parse(text), text.splitlines()))
    return tuple(found)


def nodes(*kinds: type[ast.AST]) -> Iterator[tuple[Module, ast.AST]]:
    for module in modules():
        for node in ast.walk(module.tree):
            if isinstance(node, kinds):
                yield module, node


@cache
def code_lines() -> tuple[str, ...]:
    """Lines that are neither empty, comments nor docstrings."""
    found = []
    for module in modules():
        prose = set()
        for node in ast.walk(module.tree):
            text = node.value if isinstance(node, ast.Expr) else None
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                prose.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        for number, row in enumerate(module.rows, 1):
            if row.strip() and not row.strip().startswith("#") and number not in prose:
                found.append(row)
    return tuple(found)


def parallel_assignments() -> list[str]:
    """`a, b = 1, 2`; a swap, and what unpacks one value, are none."""
    found = []
    for module, node in nodes(ast.Assign):
        assert isinstance(node, ast.Assign)
        target = node.targets[0]
        if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
            left = {ast.unparse(each) for each in target.elts}
            right = {ast.unparse(each) for each in node.value.elts}
            if left != right:
                found.append(module.at(node, ast.unparse(node)[:80]))
    return found


def conditional_expressions() -> list[str]:
    return [module.at(node) for module, node in nodes(ast.IfExp)]


def nested_conditional_expressions() -> list[str]:
    found = []
    for module, node in nodes(ast.IfExp):
        assert isinstance(node, ast.IfExp)
        if any(isinstance(part, ast.IfExp) for part in (node.test, node.body, node.orelse)):
            found.append(module.at(node, ast.unparse(node)[:80]))
    return found


def comprehensions() -> list[str]:
    kinds = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
    return [module.at(node) for module, node in nodes(*kinds)]


def functions_of_many_arguments() -> list[str]:
    found = []
    for module, node in nodes(ast.FunctionDef, ast.AsyncFunctionDef):
        assert isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        if given and given[0].arg in ("self", "cls"):
            given = given[1:]
        if len(given) > MOST_ARGUMENTS:
            found.append(module.at(node, f"{node.name} has {len(given)}"))
    return found


class Constant(NamedTuple):
    """A module's constant, in capitals."""

    name: str
    module: Module
    numeric: bool
    shared: bool
    """Its statement sets others as well."""
    said: bool
    """A comment or a docstring stands beside it."""


@cache
def constants() -> tuple[Constant, ...]:
    found = []
    for module in modules():
        commented = commented_rows(module)
        for place, node in enumerate(module.tree.body):
            if isinstance(node, ast.Assign):
                target = node.targets[0]
            elif isinstance(node, ast.AnnAssign):
                target = node.target
            else:
                continue
            parts = target.elts if isinstance(target, ast.Tuple) else [target]
            names = [part.id for part in parts if isinstance(part, ast.Name) and part.id.isupper()]
            below = module.tree.body[place + 1 : place + 2]
            documented = bool(below) and isinstance(below[0], ast.Expr)
            beside = {node.lineno - 1, node.lineno, node.end_lineno} & commented
            for name in names:
                found.append(
                    Constant(name, module, is_numeric(node.value), len(names) > 1, documented or bool(beside))
                )
    return tuple(found)


def commented_rows(module: Module) -> set[int]:
    """Numbers of the rows that hold a comment: beside code counts for it, alone for the row below."""
    text = "\n".join(module.rows) + "\n"
    found = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            found.add(token.start[0])
    return found


def is_numeric(value: ast.expr | None) -> bool:
    """True where a number stands in the value."""
    if value is None:
        return False
    literals = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    return any(isinstance(each, int | float) and not isinstance(each, bool) for each in literals)


def constants_sharing_a_statement() -> list[str]:
    return [f"{c.module.name} {c.name}" for c in constants() if c.numeric and c.shared]


def constants_without_a_word() -> list[str]:
    return [f"{c.module.name} {c.name}" for c in constants() if c.numeric and not c.said]


def private_names_of_two_files() -> list[str]:
    places = defaultdict(set)
    for constant in constants():
        if constant.name.startswith("_"):
            places[constant.name].add(constant.module.name)
    return [f"{name}: {', '.join(sorted(where))}" for name, where in places.items() if len(where) > 1]


IN_ALL = (
    (nested_conditional_expressions, 0),
    (constants_sharing_a_statement, 0),
    (constants_without_a_word, 0),
    (functions_of_many_arguments, 40),
    (private_names_of_two_files, 20),
)
IN_A_THOUSAND_LINES = (
    (parallel_assignments, 2),
    (conditional_expressions, 15),
    (comprehensions, 20),
)


@pytest.mark.parametrize(("measure", "goal"), IN_ALL, ids=lambda each: getattr(each, "__name__", ""))
def test_count(measure, goal) -> None:  # type: ignore[no-untyped-def]
    found = measure()
    assert len(found) <= goal, "\n".join(found)


@pytest.mark.parametrize(
    ("measure", "goal"), IN_A_THOUSAND_LINES, ids=lambda each: getattr(each, "__name__", "")
)
def test_share(measure, goal) -> None:  # type: ignore[no-untyped-def]
    found = measure()
    share = 1000 * len(found) / len(code_lines())
    assert share <= goal, f"{share:.1f} in 1000 lines:\n" + "\n".join(found)


def test_lines_are_short() -> None:
    rows = code_lines()
    wide = sum(len(row) > WIDE for row in rows)
    width = sum(len(row.strip()) for row in rows) / len(rows)
    assert wide <= 0.05 * len(rows)
    assert width <= 40
