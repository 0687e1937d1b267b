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
    *("errors", "version", "types", "memory", "checks", "progress", "io", "interfaces", "scenes", "configs"),
    "outputs",
    *("ops", "light", "rendering", "datamanagers", "style", "fields", "plugins", "blocks", "testing"),
    *("training", "splats", "pretraining", "reconstruction", "evaluation", "export"),
    *("page", "api", "cli", "__main__"),
)
"""Layers from the lowest to the highest. Imports within functions, such as those of `build`, may lead
anywhere.
"""
MECHANISM = ("config.py", "run_config.py", "config_files.py", "methods.py")
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


def imports(node: ast.AST, *, types: bool) -> Iterator[ast.ImportFrom]:
    """Relative imports anywhere in a module; without `types`, none for types alone, and none in a config's
    `build`, which finds its implementation.
    """
    for child in ast.iter_child_nodes(node):
        for_types = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test)
        builds = isinstance(child, ast.FunctionDef) and child.name == "build"
        if not types and (for_types or builds):
            continue
        if isinstance(child, ast.ImportFrom) and child.level:
            yield child
        yield from imports(child, types=types)


def circles(*, types: bool) -> list[set[str]]:
    """Modules that import each other, directly or by way of others: the largest set first."""
    modules = {}
    for file in ROOT.rglob("*.py"):
        name = ".".join(("fprf", *file.relative_to(ROOT).with_suffix("").parts))
        modules[name.removesuffix(".__init__")] = file
    leads: dict[str, set[str]] = {name: set() for name in modules}
    for name, file in modules.items():
        package = name.split(".") if file.name == "__init__.py" else name.split(".")[:-1]
        for node in imports(ast.parse(file.read_text()), types=types):
            parts = [*package[: len(package) - node.level + 1], *(node.module or "").split(".")]
            base = ".".join(parts).removesuffix(".")
            for each in node.names:
                module = f"{base}.{each.name}"
                leads[name].add(module if module in modules else base)
        leads[name].discard(name)

    def reached(start: str) -> set[str]:
        found = set[str]()
        todo = [start]
        while todo:
            new = leads[todo.pop()] - found
            found |= new
            todo += new
        return found

    reach = {name: reached(name) for name in modules}
    found: list[set[str]] = []
    for name in modules:
        around = {other for other in reach[name] if name in reach[other]}
        if around and around not in found:
            found.append(around)
    return sorted(found, key=len, reverse=True)


def test_no_module_imports_itself_by_way_of_others() -> None:
    assert not circles(types=False)


MAX_CIRCLE = 12
"""Modules of a circle, at most, with what is imported for types and by `build`: the goal of issue 21."""
KNOTS = (
    # Fields: their config builds what learns them.
    "config testing.outputs training.blocks training.field_learner training.field_setup training.losses "
    "training.model training.style_pass",
    # A run: its config builds what learns a scene, which writes to its folder, which holds its config.
    "config_files run_config scenes training.run",
    # A data manager has a store of what an encoder gives.
    "datamanagers.features interfaces",
    "ops.rasterise.gsplat ops.rasterise.training",
    "page.following page.server page.start",
    "style.dictionary style.scene_style",
)
"""The circles that are no config with what it builds in its own package."""


def test_circles_by_types_and_builds_are_a_config_with_what_it_builds() -> None:
    found = circles(types=True)
    assert len(found[0]) <= MAX_CIRCLE
    knots = [{f"fprf.{name}" for name in knot.split()} for knot in KNOTS]
    for circle in found:
        packages = {name.rpartition(".")[0] for name in circle}
        own = len(packages) == 1 and f"{min(packages)}.config" in circle and packages != {"fprf"}
        assert own or circle in knots, sorted(circle)
    assert all(knot in found for knot in knots), "no longer a circle: take it off the list"


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


@pytest.mark.parametrize(
    "code", ["import fprf.config, fprf.config_files, fprf.methods\nreport('configs')", BUILT_INS]
)
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


SPLATS = {"fprf.splats"}
FIELDS = {"fprf.fields", "fprf.config", "fprf.plugins.samplers", "fprf.plugins.decoders"} | {
    f"fprf.training.{name}"
    for name in ("model", "blocks", "field_learner", "field_scene", "field_setup", "losses")
}
"""Modules and packages of one kind of scene alone."""
TRAINED = """
import sys
from fprf.cli.main import main
assert main(ARGS) == 0
for name in sys.modules:
    print("module", name, file=sys.stderr)
"""


@pytest.mark.parametrize(
    ("method", "others"),
    [
        (["fprf-lite", "--statistics.rays", "64"], SPLATS),
        (["fprf-splats", "--initial", "200", "--cap", "200"], FIELDS),
    ],
    ids=["fields", "gaussians"],
)
def test_a_run_imports_nothing_of_another_kind_of_scene(
    method: list[str], others: set[str], tmp_path: Path
) -> None:
    args = ["train", *method, "--data", "garden", "--downscale", "16", "--steps", "1"]
    lines = _fresh(TRAINED.replace("ARGS", repr([*args, "--output", str(tmp_path / "run")])))
    modules = {line.removeprefix("module ") for line in lines if line.startswith("module ")}
    assert "fprf.training.driver" in modules
    for name in modules:
        parts = name.split(".")
        assert not {".".join(parts[:count]) for count in range(1, len(parts) + 1)} & others, name
