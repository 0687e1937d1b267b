"""Share of small mistakes in the mathematics that the tests notice: one operator, number or clamp is changed, the
tests are run.

    python -m benchmarks mutants [--sample 40] [--kernels 16] [--seed 0] [--only MODULE ...] [--output mutants.json]

Each module of MODULES has its tests. Of all its possible mistakes a sample is drawn, a function of (module,
seed); compiled kernels get a smaller one, because each has to be compiled anew. A mistake is found where a
test fails, or where the tests take ten times their time. With an output file that is there already, only what
no test has found yet is tried again.
"""

import ast
import contextlib
import gc
import hashlib
import importlib.abc
import importlib.machinery
import json
import os
import random
import resource
import shutil
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, NamedTuple, TypeGuard

from .common import ROOT, arguments, report

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult, ast.MatMult: ast.Add, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitAnd,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
COMPARISONS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}  # fmt: skip
CLAMPS = ("clamp", "clamp_min", "clamp_max", "nan_to_num", "clip", "abs", "sqrt", "square", "exp", "expm1")
"""Methods that are left out."""
SWAPS = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "amin": "amax", "amax": "amin", "sum": "mean",
    "mean": "sum", "floor": "ceil", "ceil": "floor", "sin": "cos", "cos": "sin", "fadd": "fsub", "fsub": "fadd",
    "fmul": "fadd", "fdiv": "fmul", "argmin": "argmax", "argmax": "argmin", "any": "all", "all": "any",
    "cumsum": "cumprod", "zeros_like": "ones_like", "zeros": "ones", "logical_and": "logical_or",
}  # fmt: skip
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
        """Identity, as long as the source is the same."""
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
    changed = _Replace(target, replacement).visit(tree)
    assert isinstance(changed, ast.Module)
    return ast.fix_missing_locations(changed)


class _Replace(ast.NodeTransformer):
    def __init__(self, target: ast.AST, replacement: ast.AST) -> None:
        self.target = target
        self.replacement = replacement

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
        children: list[ast.AST] = [
            *node.args.defaults,
            *(d for d in node.args.kw_defaults if d is not None),
            *node.body,
        ]
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
    return (
        isinstance(node, ast.UnaryOp)
        and isinstance(node.op, ast.USub)
        and isinstance(node.operand, ast.Constant)
    )


def _is_all(node: ast.AST) -> bool:
    return isinstance(node, ast.Assign) and any(
        isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets
    )


def _changes(node: ast.expr | ast.stmt) -> list[tuple[str, ast.AST]]:
    """Mutations of a node, each with a description."""
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
    function = node.func
    made: list[tuple[str, ast.AST]] = []
    if isinstance(function, ast.Attribute):
        name = function.attr
        owner = function.value
        if name in CLAMPS:
            free = isinstance(owner, ast.Name) and owner.id in ("torch", "np", "math", "F")
            made.append((f"{name} left out", node.args[0] if free else owner))
        if name in SWAPS:
            made.append((f"{name} to {SWAPS[name]}", _with(node, func=_with(function, attr=SWAPS[name]))))
    elif isinstance(function, ast.Name) and function.id in SWAPS and function.id in ("min", "max"):
        made.append(
            (
                f"{function.id} to {SWAPS[function.id]}",
                _with(node, func=ast.Name(SWAPS[function.id], ast.Load())),
            )
        )
    return made


def _with(node: ast.AST, **changes: object) -> ast.AST:
    """A copy of a node with other parts; the parts themselves are shared."""
    fields = {name: getattr(node, name) for name in node._fields} | changes
    return ast.copy_location(type(node)(**fields), node)


MODULES: dict[str, tuple[str, ...]] = {
    "fprf/ops/triplane.py": ("ops/test_triplane.py",),
    "fprf/ops/dense.py": ("ops/test_dense.py",),
    "fprf/ops/guided.py": ("ops/test_guided.py",),
    "fprf/ops/dense_kernels.py": ("ops/test_dense.py",),
    "fprf/ops/guided_kernels.py": ("datamanagers/test_features.py",),
    "fprf/ops/triplane_kernels.py": ("ops/test_triplane.py",),
    "fprf/ops/simd.py": ("ops/test_dense.py", "ops/test_triplane.py", "ops/test_rasterise.py"),
    "fprf/style/look.py": ("style/test_look.py", "style/test_colours.py"),
    "fprf/style/matching.py": ("style/test_matching.py",),
    "fprf/style/statistics.py": ("style/test_statistics.py",),
    "fprf/rendering/stepfun.py": ("rendering/test_stepfun.py",),
    "fprf/rendering/space.py": ("rendering/test_space.py",),
    "fprf/rendering/renderer.py": ("rendering/test_renderer.py",),
    "fprf/rendering/cameras.py": ("rendering/test_cameras.py",),
    "fprf/rendering/lens.py": ("rendering/test_cameras.py",),
    "fprf/rendering/splines.py": ("rendering/test_paths.py",),
}
"""Each numerics module and its tests."""
COMPILED = ("_kernels.py", "simd.py")
THIRD_PARTY = (
    "torch", "torch.distributed.tensor", "hypothesis.extra.pytestplugin", "hypothesis.internal.conjecture.engine", "numpy",
    "cv2", "numba", "llvmlite", "safetensors", "pytest", "hypothesis", "kornia.color",
)  # fmt: skip
"""Imported before processes are forked."""
ROOM = 16 << 30
"""Bytes of address space: a wrong size of an array must not take the machine down."""
PATIENCE = 10
"""Times the undisturbed processor time (and a minute more) after which tests are taken to hang."""


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from another source, as if its file held it."""

    def __init__(self, name: str, path: Path, code: CodeType) -> None:
        self.name = name
        self.path = path
        self.code = code

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != self.name:
            return None
        return importlib.machinery.ModuleSpec(name, self, origin=str(self.path))

    def exec_module(self, module: ModuleType) -> None:
        module.__file__ = str(self.path)
        exec(self.code, vars(module))


@contextlib.contextmanager
def compiled_anew(wanted: bool) -> Iterator[None]:
    """What numba keeps is found by a function's own code: a change in what is compiled into it would not be
    noticed.

    Arrays are held to their bounds, as `tests/ops/test_operator_table.py` does: else what lies beside them
    decides.
    """
    if not wanted:
        yield
        return
    import numba

    config: Any = numba.config
    base = "/dev/shm" if Path("/dev/shm").is_dir() else None
    usual = config.CACHE_DIR, config.BOUNDSCHECK
    config.CACHE_DIR = tempfile.mkdtemp(prefix="fprf-numba-", dir=base)
    config.BOUNDSCHECK = 1
    try:
        yield
    finally:
        shutil.rmtree(config.CACHE_DIR, ignore_errors=True)
        config.CACHE_DIR, config.BOUNDSCHECK = usual


def run_tests(module: str, code: CodeType | None, seconds: float, root: Path) -> tuple[int, float]:
    """Run a module's tests in a forked process, with its code changed or as it is; exit code and processor
    time.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with compiled_anew(module.endswith(COMPILED)):
        child = os.fork()
        if child == 0:
            try:
                os._exit(_in_child(module, code, seconds, root))
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(99)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return status, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _in_child(module: str, code: CodeType | None, seconds: float, root: Path) -> int:
    import pytest

    quiet = os.open(os.devnull, os.O_WRONLY)
    if code is not None:
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))
    os.chdir(root)
    sys.path[:0] = [str(root), str(root / "tests")]
    for name in [
        name for name in sys.modules if name.partition(".")[0] == "fprf"
    ]:  # those of reports, which are not changed
        del sys.modules[name]
    if code is not None:
        name = module.removesuffix(".py").replace("/", ".")
        sys.meta_path.insert(0, Changed(name, root / module, code))
    tests = [str(path) for name in MODULES[module] if (path := root / "tests" / name).exists()]
    if not tests:
        return 98
    return int(
        pytest.main(["-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "--hypothesis-seed=0", *tests])
    )


def chosen(source: str, module: str, count: int, seed: int) -> tuple[list[Mutation], int]:
    """A sample of the mistakes, in the order of the source, and how many there are."""
    every = mutations(ast.parse(source))
    draw = random.Random(f"{module} {seed}")
    return sorted(draw.sample(every, min(count, len(every)))), len(every)


def measure_module(
    module: str, count: int, seed: int, old: dict[str, Any], root: Path = ROOT
) -> dict[str, Any]:
    """Try a sample of a module's mistakes; those that `old` knows to be found are not tried again."""
    source = (root / module).read_text()
    digest = hashlib.sha256(source.encode()).hexdigest()[:16]
    sample, every = chosen(source, module, count, seed)
    known = set(old["found"]) if old.get("source") == digest else set()
    run_tests(module, None, 3000, root)  # the first one compiles what nobody changes
    usual_code, usual = run_tests(module, None, 3000, root)
    if usual_code:
        raise SystemExit(f"{module}: its tests fail without any change ({usual_code})")
    found = []
    survived = []
    for mutation in sample:
        name = mutation.name
        if name not in known:
            code = compile(mutated(source, mutation), str(root / module), "exec")
            status, _ = run_tests(module, code, PATIENCE * usual + 60, root)
            if status == 0:
                line = source.splitlines()[mutation.line - 1].strip()
                survived.append({"where": f"{module}:{mutation.line}", "change": name, "line": line})
                print(f"  survived {module}:{mutation.line} {name} | {line}", flush=True)
                continue
        found.append(name)
    return {"source": digest, "possible": every, "tried": len(sample), "found": found, "survived": survived}


def main(argv: list[str]) -> None:
    parser = arguments("mutants", __doc__)
    parser.add_argument("--sample", type=int, default=40)
    parser.add_argument("--kernels", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], metavar="MODULE")
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args(argv)
    for name in THIRD_PARTY:
        importlib.import_module(name)
    gc.freeze()  # else every child walks over all of torch, several times
    document: dict[str, Any] = {"modules": {}}
    if asked.output is not None and asked.output.exists():
        document = json.loads(asked.output.read_text())
    document["command"] = (
        f"python -m benchmarks mutants --sample {asked.sample} --kernels {asked.kernels} --seed {asked.seed}"
    )
    for module in MODULES:
        if asked.only and module not in asked.only:
            continue
        count = asked.kernels if module.endswith(COMPILED) else asked.sample
        row = measure_module(module, count, asked.seed, document["modules"].get(module, {}))
        document["modules"][module] = row
        print(
            f"{module}: {len(row['found'])} of {row['tried']} found, of {row['possible']} possible",
            flush=True,
        )
        document["tried"] = sum(each["tried"] for each in document["modules"].values())
        document["found"] = sum(len(each["found"]) for each in document["modules"].values())
        if asked.output is not None:
            report(asked.output, document)
