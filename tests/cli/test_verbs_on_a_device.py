"""Verbs with `--device cuda:0`, pretended: the files of the CPU, bit for bit, where both take plain torch."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pretend_cuda import pretend_cuda
from tiny_world import World

from fprf.cli import main as cli
from fprf.ops import backend
from fprf.plugins.weights import read_weights

VIEW = ["--views", "0000"]
QUICK = ["--clusters", "3"]
SMALL = ["--side", "16", "--views", "3", "--fit", "1e-6", "--fit-cap", "50"]
DEVICE = "cuda:0"
APPLE = "mps:0"


def ran(args: list[str], device: str) -> dict[str, int]:
    """Host waits of a verb, by operator. `mps` has no float64."""
    if device == "cpu":
        with backend.plain():
            assert cli.main([*args, "--device", device]) == 0
        return {}
    with pretend_cuda(mps=device == APPLE) as seen:
        assert cli.main([*args, "--device", device, "--debug"]) == 0
    assert seen.uploads, "nothing was on the device"
    return dict(seen.syncs)


def content(path: Path) -> Any:
    """What a file says, without times."""
    if path.suffix == ".json":
        return timeless(json.loads(path.read_text()))
    if path.suffix == ".safetensors":
        tensors, metadata = read_weights(path)
        return metadata, {name: tensor.numpy().tobytes() for name, tensor in tensors.items()}
    return path.read_bytes()


def timeless(value: Any) -> Any:
    clocks = ("seconds", "seconds_per_view", "rays_per_second", "peak_rss_mib", "run", "output")
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if not k.endswith(clocks)}
    return [timeless(each) for each in value] if isinstance(value, list) else value


def same(here: Path, there: Path) -> None:
    names = {p.relative_to(here) for p in here.rglob("[!.]*") if p.is_file()}
    assert names and names == {p.relative_to(there) for p in there.rglob("[!.]*") if p.is_file()}
    for name in sorted(names):
        assert content(here / name) == content(there / name), name


def between(world: World, folder: Path) -> list[str]:
    """A style on the way to another, with regions that are kept and pinned."""
    style = {"format": 1, "style": {"references": [str(world.references[1])], "clusters": 3}}
    (folder / "other.json").write_text(json.dumps(style))
    controls = (
        "--keep 0 --pin 1=dusk.png --forbid 2=snow.png --strength 0.7 --luminance 0.5 --at 0.3 --output OUT"
    )
    return [*references(world), "--between", str(folder / "other.json"), *controls.split()]


def references(world: World) -> list[str]:
    return ["--references", *map(str, world.references), *QUICK]


SPIRAL = "--path spiral --frames 2 --resolution 0.5 --show colour depth normals --output OUT"
EVERYTHING = "ply splat glb cameras --images --output OUT"
VERBS: dict[str, Callable[[World, Path], list[str]]] = {
    "stylize": lambda world, folder: [*VIEW, *between(world, folder)],
    "render": lambda *_: SPIRAL.split(),
    "export": lambda world, _: [*EVERYTHING.split(), *SMALL, *references(world)],
}


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("stylize", DEVICE),
        ("stylize", APPLE),
        ("render", DEVICE),
        pytest.param("export", DEVICE, marks=pytest.mark.slow),
    ],
)
def test_a_verb_writes_what_the_cpu_writes(world: World, tmp_path: Path, name: str, there: str) -> None:
    outputs = [tmp_path / device for device in ("cpu", "other")]
    for output, device in zip(outputs, ("cpu", there), strict=True):
        output.mkdir()
        args = [name.split()[0], str(world.run), *VERBS[name](world, tmp_path)]
        ran([arg.replace("OUT", str(output)) for arg in args], device)
    same(*outputs)
