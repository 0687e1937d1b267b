"""Mutants: what is changed, that one thing is, and that tests are asked about it."""

import ast
from pathlib import Path

from benchmarks import mutants

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SOURCE = '''"""1 + 1 in a docstring."""
import math

__all__ = ["f"]
LIMIT: int = 3


def f(x: "1 + 1", y=2.0):
    """2 * 2"""
    if x < 1 and not y:
        raise ValueError(f"{1 + 1} and {2 * 2}")
    assert x != 7
    y[0] = -x
    return max(abs(x), math.sqrt(y)) + x.clamp_min(0) if x else x
'''


def test_each_change_is_one_and_none_is_the_source() -> None:
    plain = ast.unparse(ast.parse(SOURCE))
    texts = [ast.unparse(mutants.mutated(SOURCE, each)) for each in mutants.mutations(ast.parse(SOURCE))]
    assert len(set(texts)) == len(texts) and plain not in texts
    for text in texts:
        different = [a for a, b in zip(text.splitlines(), plain.splitlines(), strict=True) if a != b]
        assert len(different) == 1


def test_samples_are_functions_of_module_and_seed_and_every_module_has_tests() -> None:
    source = (BENCHMARKS.parent / "fprf/rendering/stepfun.py").read_text()
    first, every = mutants.chosen(source, "a", 20, 0)
    assert first == mutants.chosen(source, "a", 20, 0)[0] and len(first) == 20 < every
    assert first != mutants.chosen(source, "b", 20, 0)[0] and first != mutants.chosen(source, "a", 20, 1)[0]
    assert len(mutants.chosen(source, "a", 10**6, 0)[0]) == every
    for module, tests in mutants.MODULES.items():
        assert (BENCHMARKS.parent / module).is_file(), module
        assert any((BENCHMARKS.parent / "tests" / name).is_file() for name in tests), module
