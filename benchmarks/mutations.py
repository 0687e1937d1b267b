"""Small mistakes for a source of Python: another operator, number or comparison, a clamp, a sign or a statement left out.

`mutations` lists what could be changed, as places in the tree; `mutated` gives the source with one of them. Docstrings,
annotations, decorators, imports, messages of errors and asserts are left alone: no test of numbers could notice.
"""

import ast
from collections.abc import Iterator
from typing import NamedTuple, TypeGuard

__all__ = ["Mutation", "mutated", "mutations"]

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.MatMult: ast.Add,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
COMPARISONS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
CLAMPS = ("clamp", "clamp_min", "clamp_max", "nan_to_num", "clip", "abs", "sqrt", "square", "exp", "expm1")
"""Methods that are left out."""
SWAPS = {
    "min": "max",
    "max": "min",
    "minimum": "maximum",
    "maximum": "minimum",
    "amin": "amax",
    "amax": "amin",
    "sum": "mean",
    "mean": "sum",
    "floor": "ceil",
    "ceil": "floor",
    "sin": "cos",
    "cos": "sin",
    "fadd": "fsub",
    "fsub": "fadd",
    "fmul": "fadd",
    "fdiv": "fmul",
    "argmin": "argmax",
    "argmax": "argmin",
    "any": "all",
    "all": "any",
    "cumsum": "cumprod",
    "zeros_like": "ones_like",
    "zeros": "ones",
    "logical_and": "logical_or",
}
AXES = ("sum", "mean", "cumsum", "cat", "stack", "amax", "amin", "softmax", "diff", "sort", "unbind", "gather", "squeeze",
        "norm", "unsqueeze", "median", "all", "any", "cross", "prod", "argmax", "argmin", "new_zeros", "view", "reshape",
        "flatten", "logsumexp", "repeat_interleave", "movedim", "log_softmax", "normalize")  # fmt: skip
"""Calls whose arguments name axes: of a matrix, axis 1 is axis -1, and no test could tell."""
SKIPPED = (ast.Raise, ast.Assert, ast.Import, ast.ImportFrom, ast.JoinedStr)


class Mutation(NamedTuple):
    """One change: the number of the node in the order of the walk, and which of its changes."""

    line: int
    column: int
    node: int
    which: int
    what: str

    @property
    def name(self) -> str:
        """What identifies it as long as the source is the same."""
        return f"{self.line}:{self.column} {self.what}"


def mutations(tree: ast.Module) -> list[Mutation]:
    """All changes of a module."""
    found = []
    for number, node in enumerate(_nodes(tree)):
        for which, (what, _) in enumerate(_changes(node)):
            found.append(Mutation(node.lineno, node.col_offset, number, which, what))
    return found


def mutated(source: str, mutation: Mutation) -> ast.Module:
    """The tree with one change."""
    tree = ast.parse(source)
    target = next(node for number, node in enumerate(_nodes(tree)) if number == mutation.node)
    replacement = _changes(target)[mutation.which][1]
    changed: ast.Module = _Replace(target, replacement).visit(tree)
    return ast.fix_missing_locations(changed)


class _Replace(ast.NodeTransformer):
    def __init__(self, target: ast.AST, replacement: ast.AST) -> None:
        self.target, self.replacement = target, replacement

    def visit(self, node: ast.AST) -> ast.AST:
        if node is self.target:
            return ast.copy_location(self.replacement, node)
        return self.generic_visit(node)


def _nodes(node: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    """Expressions and statements that count, in a fixed order."""
    if isinstance(node, SKIPPED) or _is_all(node):
        return
    if isinstance(node, ast.expr | ast.stmt):
        yield node
    if isinstance(node, ast.FunctionDef):
        children: list[ast.AST] = [*node.args.defaults, *(d for d in node.args.kw_defaults if d is not None), *node.body]
    elif isinstance(node, ast.ClassDef):
        children = list(node.body)
    elif isinstance(node, ast.AnnAssign):
        children = [] if node.value is None else [node.value]
    elif isinstance(node, ast.Assign):
        children = [*node.targets, node.value]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in AXES:
        children = [child.operand if _is_axis(child) else child for child in (node.func, *node.args)]
        children += [k.value.operand if _is_axis(k.value) else k.value for k in node.keywords]
    else:
        children = list(ast.iter_child_nodes(node))
    for child in children:
        if not (isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)):  # a docstring
            yield from _nodes(child)


def _is_axis(node: ast.AST) -> TypeGuard[ast.UnaryOp]:
    return isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant)


def _is_all(node: ast.AST) -> bool:
    return isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets)


def _changes(node: ast.expr | ast.stmt) -> list[tuple[str, ast.AST]]:
    """What may become of a node, each with a description."""
    made: list[tuple[str, ast.AST]] = []
    if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in OPERATORS:
        other = OPERATORS[type(node.op)]
        made.append((f"{type(node.op).__name__} to {other.__name__}", _with(node, op=other())))
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        for kind in COMPARISONS[type(node.ops[0])]:
            made.append((f"{type(node.ops[0]).__name__} to {kind.__name__}", _with(node, ops=[kind()])))
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
        made.append((f"{type(node.op).__name__} left out", node.operand))
    elif isinstance(node, ast.Constant):
        made += _constants(node)
    elif isinstance(node, ast.Call):
        made += _calls(node)
    elif isinstance(node, ast.IfExp):
        made.append(("the other case", _with(node, body=node.orelse, orelse=node.body)))
    elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript):
        made.append(("statement left out", ast.Pass()))
    return made


def _constants(node: ast.Constant) -> list[tuple[str, ast.AST]]:
    value = node.value
    if isinstance(value, bool):
        return [(f"{value} to {not value}", ast.Constant(not value))]
    if isinstance(value, int):
        return [(f"{value} to {value + 1}", ast.Constant(value + 1))]
    if isinstance(value, float):
        other = 1.0 if value == 0 else 2 * value
        return [(f"{value:g} to {other:g}", ast.Constant(other))]
    return []


def _calls(node: ast.Call) -> list[tuple[str, ast.AST]]:
    function, made = node.func, []
    if isinstance(function, ast.Attribute):
        name, owner = function.attr, function.value
        if name in CLAMPS:
            free = isinstance(owner, ast.Name) and owner.id in ("torch", "np", "math", "F")
            made.append((f"{name} left out", node.args[0] if free else owner))
        if name in SWAPS:
            made.append((f"{name} to {SWAPS[name]}", _with(node, func=_with(function, attr=SWAPS[name]))))
    elif isinstance(function, ast.Name) and function.id in SWAPS and function.id in ("min", "max"):
        made.append((f"{function.id} to {SWAPS[function.id]}", _with(node, func=ast.Name(SWAPS[function.id], ast.Load()))))
    return made


def _with(node: ast.AST, **changes: object) -> ast.AST:
    """A copy of a node with other parts; the parts themselves are shared."""
    fields = {name: getattr(node, name) for name in node._fields} | changes
    return ast.copy_location(type(node)(**fields), node)
