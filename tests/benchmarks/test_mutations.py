"""Mutants: what is changed, that one thing is, and that tests are asked about it."""

import ast
import json
import subprocess
import sys
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


def test_mistakes_that_tests_notice_are_told_from_those_that_they_do_not(
    tmp_path: Path,
) -> None:
    """In a small tree of its own, each run in a forked process."""
    (tmp_path / "toyish").mkdir()
    (tmp_path / "toyish" / "__init__.py").write_text("")
    source = "def f(x):\n    return x + 1\n\ndef unseen(x):\n    return x * 2\n"
    (tmp_path / "toyish" / "sums.py").write_text(source)
    (tmp_path / "tests").mkdir()
    test = "from toyish.sums import f, unseen\n\ndef test_f():\n    assert f(2) == 3 and unseen(1) == 2 and unseen(0) == 0\n"
    (tmp_path / "tests" / "test_toyish_sums.py").write_text(test)
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\n")
    program = f"""
import sys; sys.path[:0] = [{str(BENCHMARKS.parent)!r}]
import json; from benchmarks import mutants; from pathlib import Path
mutants.MODULES["toyish/sums.py"] = ("test_toyish_sums.py",)
print(json.dumps(mutants.measure_module("toyish/sums.py", 100, 0, {{}}, Path({str(tmp_path)!r}))))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, check=True)
    row = json.loads(done.stdout.splitlines()[-1])
    assert row["possible"] == row["tried"] == 4
    assert row["found"] == ["2:11 Add to Sub", "2:15 1 to 2", "5:11 Mult to Div", "5:15 2 to 3"] and row["survived"] == []
    (tmp_path / "tests" / "test_toyish_sums.py").write_text(test.replace("unseen(1) == 2 and ", ""))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, check=True)
    row = json.loads(done.stdout.splitlines()[-1])
    assert [each["change"] for each in row["survived"]] == ["5:11 Mult to Div", "5:15 2 to 3"]
    assert row["survived"][0]["where"] == "toyish/sums.py:5" and row["survived"][0]["line"] == "return x * 2"
