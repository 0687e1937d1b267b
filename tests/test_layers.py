"""Packages import each other in one direction, also within functions; help and configs import nothing
heavy.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import fprf
from fprf.cli.main import VERBS

ROOT = Path(fprf.__file__).parent
ORDER = (
    *("version", "errors", "types", "memory", "checks", "progress", "io", "interfaces", "configs", "outputs"),
    *("ops", "rendering", "datamanagers", "style", "fields", "plugins", "blocks", "testing"),
    *("training", "splats", "pretraining", "reconstruction", "evaluation", "export"),
    *("page", "api", "cli", "__main__"),
)
"""Layers from the lowest to the highest. Imports within functions, such as those of `build`, may lead
anywhere.
"""
MECHANISM = ("config.py", "methods.py")
"""Files of any package that belong to the configs, as do the modules of `plugins` itself: none of them
imports torch.
"""


def layer(parts: tuple[str, ...]) -> str:
    """The layer of a module by its path below `fprf`."""
    if parts in ((), ("__init__",)):
        return "version"
    if parts == ("testing", "outputs"):  # which the program uses as well
        return "outputs"
    plugins = parts[0] == "plugins" and len(parts) <= 2 and parts[-1] != "weights"
    return "configs" if plugins or (f"{parts[-1]}.py" in MECHANISM and parts[0] != "export") else parts[0]


def imported(file: Path) -> Iterator[tuple[str, ...]]:
    """Paths below `fprf` of the modules that a module imports when it is loaded."""
    here = file.relative_to(ROOT).parts[:-1]
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.level:
            base = (*here[: len(here) - node.level + 1], *(node.module.split(".") if node.module else ()))
            for alias in node.names:
                whole = (*base, alias.name)
                module = (
                    ROOT.joinpath(*whole).with_suffix(".py").is_file() or ROOT.joinpath(*whole).is_dir()
                ) and alias.name
                yield whole if module else base


def test_imports_lead_to_lower_layers() -> None:
    breaches = set()
    for file in ROOT.rglob("*.py"):
        own = layer(file.relative_to(ROOT).with_suffix("").parts)
        for other in map(layer, imported(file)):
            if own != other and "__init__" not in (own, other):
                assert own in ORDER and other in ORDER, f"{own} or {other} has no place in ORDER"
                if ORDER.index(other) > ORDER.index(own):
                    breaches.add(f"{file.relative_to(ROOT)}: {own} imports {other}")
    assert not breaches


def imports(tree: ast.AST) -> Iterator[ast.ImportFrom]:
    """Relative imports anywhere in a module but in a config's `build`, which finds its implementation, and
    for types alone.
    """
    for node in ast.iter_child_nodes(tree):
        for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)
        if for_types or (isinstance(node, ast.FunctionDef) and node.name == "build"):
            continue
        if isinstance(node, ast.ImportFrom) and node.level:
            yield node
        yield from imports(node)


def test_no_module_imports_itself_by_way_of_others() -> None:
    names = {
        ".".join(("fprf", *file.relative_to(ROOT).with_suffix("").parts)): file for file in ROOT.rglob("*.py")
    }
    modules = {name.removesuffix(".__init__"): file for name, file in names.items()}
    leads: dict[str, set[str]] = {name: set() for name in modules}
    for name, file in modules.items():
        package = name.split(".") if file.name == "__init__.py" else name.split(".")[:-1]
        for node in imports(ast.parse(file.read_text())):
            base = ".".join(
                [*package[: len(package) - node.level + 1], *(node.module or "").split(".")]
            ).removesuffix(".")
            leads[name] |= {
                f"{base}.{each.name}" if f"{base}.{each.name}" in modules else base for each in node.names
            } - {name}

    def reached(start: str) -> set[str]:
        found = set()
        todo = [start]
        while todo:
            new = leads[todo.pop()] - found
            found |= new
            todo += new
        return found

    reach = {name: reached(name) for name in modules}
    circles = {
        tuple(sorted(other for other in reach[name] if name in reach[other]))
        for name in modules
        if name in reach[name]
    }
    assert not circles


HEAVY = ("torch", "numpy", "cv2", "kornia", "trimesh", "numba", "safetensors", "transformers", "av")
BUILT_INS = """
from fprf.plugins import registry
for group in registry.groups():
    # Of formats and kinds of scenes the names are all that is asked before a file is read.
    for name in registry.installed(group) if group not in ("fprf.captures", "fprf.scenes") else ():
        if registry.entry(group, name).package.startswith("fprf "):
            registry.load_object(group, name)()
            report(f"{group} {name}")
"""
COMMANDS = [
    ["--help"],
    ["plugins"],
    ["train"],
    ["train", "--help"],
    ["train", "fprf", "--help"],
    ["train", "fprf-lite", "--sampler", "uniform", "--help"],
    ["train", "fprf", "--stpes", "3"],
    *([verb, "--help"] for verb in VERBS if verb != "train"),
]


def _fresh(code: str) -> list[str]:
    """Run in a new interpreter, in which warnings are errors; lines on standard error."""
    before = f"import sys\ndef report(what): print(what, *({{*{HEAVY!r}}} & {{*sys.modules}}), sep='|', file=sys.stderr)\n"
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", before + code],
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stderr.splitlines()


@pytest.mark.parametrize("code", ["import fprf.config, fprf.methods\nreport('configs')", BUILT_INS])
def test_configs_import_nothing_heavy(code: str) -> None:
    lines = _fresh(code)
    assert lines and not [line for line in lines if "|" in line]


def test_help_and_parsing_import_nothing_heavy() -> None:
    code = (
        f"from fprf.cli.main import main\nfor args in {COMMANDS!r}:\n    report(f'{{args}} {{main(args)}}')"
    )
    lines = [line for line in _fresh(code) if line.startswith("[")]
    codes = [2 if args in (["train"], ["train", "fprf", "--stpes", "3"]) else 0 for args in COMMANDS]
    assert lines == [f"{args} {code}" for args, code in zip(COMMANDS, codes, strict=True)]


@pytest.mark.parametrize(("args", "seconds"), [(["--help"], 0.4), (["train", "fprf", "--help"], 1.5)])
def test_help_takes_little_processor_time(args: list[str], seconds: float) -> None:
    code = f"import time\nfrom fprf.cli.main import main\nmain({args!r})\nreport(time.process_time())"
    spent = [float(_fresh(code)[-1])]
    if spent[0] >= seconds:  # the machine may have been busy
        spent.append(float(_fresh(code)[-1]))
    assert min(spent) < seconds, f"fprf {' '.join(args)}: {spent} s of processor time"
