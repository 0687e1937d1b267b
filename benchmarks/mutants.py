"""How many small mistakes in the mathematics the tests notice: one operator, number or clamp is changed, the tests are run.

    python benchmarks/mutants.py [--sample 40] [--kernels 16] [--seed 0] [--only MODULE ...] [--output mutants.json]

Each module of MODULES has its tests. Of all its possible mistakes a sample is drawn, a function of (module, seed); compiled
kernels get a smaller one, because each has to be compiled anew. A mistake is found where a test fails, or where the tests take
ten times their time. With an output file that is there already, only what no test has found yet is tried again.
"""

import argparse
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
from typing import Any

from mutations import Mutation, mutated, mutations

ROOT = Path(__file__).resolve().parents[1]
MODULES: dict[str, tuple[str, ...]] = {
    "fprf/ops/march.py": ("ops/test_march.py", "ops/test_march_gradients.py"),
    "fprf/ops/triplane.py": ("ops/test_triplane.py", "ops/test_variation.py", "ops/test_point_slopes.py"),
    "fprf/ops/triplane_numba.py": ("ops/test_triplane.py", "ops/test_variation.py", "ops/test_point_slopes.py"),
    "fprf/ops/dense.py": ("ops/test_dense.py",),
    "fprf/ops/exponential.py": ("ops/test_exponential.py", "ops/test_march.py"),
    "fprf/ops/guided.py": ("ops/test_guided.py",),
    "fprf/ops/mixture.py": ("ops/test_mixture.py",),
    "fprf/ops/march_kernels.py": ("ops/test_march.py", "ops/test_march_gradients.py"),
    "fprf/ops/march_gradient_kernels.py": ("ops/test_march.py", "ops/test_march_gradients.py"),
    "fprf/ops/dense_kernels.py": ("ops/test_dense.py",),
    "fprf/ops/dense_gradients.py": ("ops/test_dense.py",),
    "fprf/ops/guided_kernels.py": ("datamanagers/test_features.py",),
    "fprf/ops/mixture_kernels.py": ("ops/test_mixture.py",),
    "fprf/ops/triplane_kernels.py": ("ops/test_triplane.py", "ops/test_variation.py", "ops/test_point_slopes.py"),
    "fprf/ops/tile.py": ("ops/test_dense.py", "ops/test_mixture.py"),
    "fprf/ops/vector.py": ("ops/test_triplane.py", "ops/test_point_slopes.py", "ops/test_march.py"),
    "fprf/ops/rows.py": ("ops/test_dense.py", "ops/test_march.py"),
    "fprf/style/clusters.py": ("style/test_clusters.py",),
    "fprf/style/colours.py": ("style/test_colours.py",),
    "fprf/style/controls.py": ("style/test_controls.py",),
    "fprf/style/matching.py": ("style/test_matching.py", "ops/test_mixture.py"),
    "fprf/style/regional.py": ("style/test_regional.py",),
    "fprf/style/statistics.py": ("style/test_statistics.py",),
    "fprf/style/transport.py": ("style/test_transport.py",),
    "fprf/rendering/stepfun.py": ("rendering/test_stepfun.py", "rendering/test_stepfun_edges.py"),
    "fprf/rendering/space.py": ("rendering/test_space.py", "rendering/test_space_plain.py", "ops/test_march.py"),
    "fprf/rendering/renderer.py": ("rendering/test_renderer.py", "rendering/test_renderer_edges.py"),
    "fprf/rendering/cameras.py": ("rendering/test_cameras.py",),
    "fprf/rendering/lens.py": ("rendering/test_lens.py", "rendering/test_cameras.py"),
    "fprf/rendering/pixel_rays.py": ("rendering/test_pixel_rays.py",),
    "fprf/rendering/normals.py": ("rendering/test_normals.py",),
    "fprf/rendering/splines.py": ("rendering/test_splines.py",),
}
"""Each numerics module and its tests."""
COMPILED = ("_kernels.py", "dense_gradients.py", "tile.py", "vector.py", "rows.py", "exponential.py", "triplane_numba.py")
THIRD_PARTY = (
    "torch",
    "torch.distributed.tensor",
    "hypothesis.extra.pytestplugin",
    "hypothesis.internal.conjecture.engine",
    "numpy",
    "cv2",
    "numba",
    "llvmlite",
    "safetensors",
    "pytest",
    "hypothesis",
    "kornia.color",
)
"""What is imported before processes are forked; nothing of ours may be."""
ROOM = 16 << 30
"""Bytes of address space: a wrong size of an array must not take the machine down."""
PATIENCE = 10
"""Times the undisturbed processor time (and a minute more) after which tests are taken to hang."""


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from another source, as if its file held it."""

    def __init__(self, name: str, path: Path, code: CodeType) -> None:
        self.name, self.path, self.code = name, path, code

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
    """What numba keeps is found by a function's own code: a change in what is compiled into it would not be noticed.

    Arrays are held to their bounds, as `tests/ops/test_within_arrays.py` does: else what lies beside them decides.
    """
    if not wanted:
        yield
        return
    import numba

    base = "/dev/shm" if Path("/dev/shm").is_dir() else None
    usual = numba.config.CACHE_DIR, numba.config.BOUNDSCHECK
    numba.config.CACHE_DIR, numba.config.BOUNDSCHECK = tempfile.mkdtemp(prefix="fprf-numba-", dir=base), 1
    try:
        yield
    finally:
        shutil.rmtree(numba.config.CACHE_DIR, ignore_errors=True)
        numba.config.CACHE_DIR, numba.config.BOUNDSCHECK = usual


def run_tests(module: str, code: CodeType | None, seconds: float, root: Path) -> tuple[int, float]:
    """Run a module's tests in a forked process, with its code changed or as it is; exit code and processor time."""
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
    if code is not None:
        name = module.removesuffix(".py").replace("/", ".")
        sys.meta_path.insert(0, Changed(name, root / module, code))
    tests = [str(path) for name in MODULES[module] if (path := root / "tests" / name).exists()]
    if not tests:
        return 98
    return int(pytest.main(["-x", "-q", "--assert=plain", "-p", "no:cacheprovider", "--hypothesis-seed=0", *tests]))


def chosen(source: str, module: str, count: int, seed: int) -> tuple[list[Mutation], int]:
    """A sample of the mistakes, in the order of the source, and how many there are."""
    every = mutations(ast.parse(source))
    draw = random.Random(f"{module} {seed}")
    return sorted(draw.sample(every, min(count, len(every)))), len(every)


def measure_module(module: str, count: int, seed: int, old: dict[str, Any], root: Path = ROOT) -> dict[str, Any]:
    """Try a sample of a module's mistakes; those that `old` knows to be found are not tried again."""
    source = (root / module).read_text()
    digest = hashlib.sha256(source.encode()).hexdigest()[:16]
    sample, every = chosen(source, module, count, seed)
    known = set(old["found"]) if old.get("source") == digest else set()
    run_tests(module, None, 3000, root)  # the first one compiles what nobody changes
    usual_code, usual = run_tests(module, None, 3000, root)
    if usual_code:
        raise SystemExit(f"{module}: its tests fail without any change ({usual_code})")
    found, survived = [], []
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sample", type=int, default=40)
    parser.add_argument("--kernels", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], metavar="MODULE")
    parser.add_argument("--output", type=Path)
    asked = parser.parse_args()
    for name in THIRD_PARTY:
        importlib.import_module(name)
    gc.freeze()  # else every child walks over all of torch, several times
    document: dict[str, Any] = {"modules": {}}
    if asked.output is not None and asked.output.exists():
        document = json.loads(asked.output.read_text())
    document["command"] = f"python benchmarks/mutants.py --sample {asked.sample} --kernels {asked.kernels} --seed {asked.seed}"
    for module in MODULES:
        if asked.only and module not in asked.only:
            continue
        count = asked.kernels if module.endswith(COMPILED) else asked.sample
        row = measure_module(module, count, asked.seed, document["modules"].get(module, {}))
        document["modules"][module] = row
        print(f"{module}: {len(row['found'])} of {row['tried']} found, of {row['possible']} possible", flush=True)
        document["tried"] = sum(each["tried"] for each in document["modules"].values())
        document["found"] = sum(len(each["found"]) for each in document["modules"].values())
        if asked.output is not None:
            asked.output.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
