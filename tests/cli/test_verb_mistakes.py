"""Mistakes that a user can make with each verb: exit 2, one line that names what is wrong, and nothing is
written.
"""

import json
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from splat_ball import ball
from tiny_world import World

from fprf.cli import main as cli
from fprf.splats.files import write_gaussians

MISTAKES = """
    doctor run --device x | --device
    doctor absent | absent
    doctor empty | empty
    doctor a b | 'b'
    doctor run --clean | --clean
    doctor --clean --device cpu | --clean
    eval | RUN is missing
    eval absent | no run folder
    eval run --split half | --split half
    eval run --size 0 | --size
    eval untold --tensorboard out --split all | no events.jsonl
    eval run --quality great | --quality great: it takes draft or standard or best
    eval moved | gone: no such folder
    eval other | its images are not those of the run
    eval untested | --split test
    export run plx | 'plx'
    export run ksplat | ksplat is read, not written
    export absent usdz | pip install usd-core
    export run --fit 0 | --fit
    export run --views 1 | --views
    export run --mesh-edge 0 | --mesh-edge
    export run --styles A | NAME=
    export run --styles a=absent.png | absent.png
    export run --styles compressed=A.png | another format
    export run --styles a=x.png b=x.png --output out/one.ply | one file holds one style
    export run cameras --output out/one.splat | holds splat
    export run glb --reach 1e-6 --output out | no view sees a surface
    gallery run | --references
    gallery in.ply --references A.png | `fprf restyle in.ply
    gallery untested --references A.png --split test | --split test
    gallery run --references empty | no image
    gallery run --references A.png --output page.pdf | page.pdf
    gallery run --references A.png --output /proc/x.html | /proc/x.html: cannot be written
    render untested --split test | --split test
    render untested --path dataset --split test | --split test
    render run --path spirale | --path spirale
    render run --path path.json | path.json
    render run --show match --path orbit | --show match
    render run --format exr | --format
    render run --styles dusk --path orbit | NAME=
    render run --path orbit --frames 2 --output a.mov | .mp4
    render run --path orbit --frames 2 --output path.json | path.json: cannot be written
    render run --path orbit --frames 2 --fps 1e9 --output a.mp4 | --fps 1e+09
    render run --keyframes absent.json | absent.json
    render run --keyframes keys.json --references A.png | --keyframes
    restyle --references A.png --output out.ply | name a capture
    restyle in.ply --output out.ply | --references
    restyle in.ply --references A.png | --output
    restyle in.ply --references A.png --output out.obj | out.obj
    restyle in.ply --references A.png --output out.ksplat | read, not written
    restyle in.ply --references absent.png --output out.usdz | pip install usd-core
    restyle in.ply --references A.png --output out.ply --up 0 0 0 | up
    restyle in.ply --references A.png --page out.png | --page
    restyle in.ply in.ply --references A.png --output out | several captures
    restyle in.ply other.spz --references A.png --output out.ply | need a folder
    restyle in.ply other.spz --references A.png --output . | is read by this command
    stylize run | --references
    stylize run --references A.png --forbid 0=0 | region 0
    stylize run --references A.png --keep 0000:99,1 | 0000:99,1
    stylize run --references A.png --between absent.json | absent.json
    stylize run --references A.png --views 000 | --views 000
    stylize run --references A.png --stylizer region-to | 'region-tone'
    stylize untested --references A.png --split test | --split test
    train --sampler uniform | --sampler
    train fprf-lite --loss.rgb 0 --loss.content 0 --loss.semantic 0 | nothing would be learnt
    train absent/config.json | absent/config.json
    train fprf-lite | --data
    train fprf-lite --data absent | absent: no such folder
    train fprf-lite --data empty | but nothing
    train run/config.json --device tpu | 'tpu'
    view run --port 70000 | --port
    view run --pixels 3 | --pixels
    view run --token short | --token
    view run --host no.such.host.invalid --port 0 --token a-long-enough-token | no.such.host.invalid
    view photos --port 0 | no config.json
    view photos.ply --port 0 --follow | --follow
    view run --port 0 --references 1 2 3 4 5 6 7 8 9 10 11 12 13 | takes 12
"""


@pytest.fixture(scope="module")
def _place(_world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders and files of the names above."""
    folder = tmp_path_factory.mktemp("mistakes")
    for name in ("run", "moved", "other", "untested", "untold"):
        shutil.copytree(_world.run, folder / name)
    (folder / "untold" / "events.jsonl").unlink()
    for name in ("photos", "empty"):
        (folder / name).mkdir()
    for name, path in zip("AB", _world.references, strict=True):
        shutil.copy(path, folder / f"{name}.png")
    town = shutil.copytree(_world.town, folder / "town-with-other-names")
    (town / "images" / "0003.png").rename(town / "images" / "0103.png")
    manifest = town / "transforms.json"
    manifest.write_text(manifest.read_text().replace("images/0003.png", "images/0103.png"))
    for name, data in (("moved", folder / "gone"), ("other", town)):
        config = folder / name / "config.json"
        config.write_text(config.read_text().replace(str(_world.town), str(data)))
    known = folder / "untested" / "scene.json"
    known.write_text(json.dumps(json.loads(known.read_text()) | {"test": []}))
    for name in ("in.ply", "other.spz"):
        write_gaussians(folder / name, ball(20))
    (folder / "path.json").write_text("{}")
    (folder / "keys.json").write_text(json.dumps({"format": 1, "keyframes": [{"frame": 0, "style": None}]}))
    return folder


def files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("line", [line.strip() for line in MISTAKES.strip().splitlines()])
def test_a_mistake_is_one_line(
    line: str, world: World, _place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command, _, told = line.partition(" | ")
    if command.startswith("view"):
        monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    monkeypatch.setitem(sys.modules, "pxr", None)  # usd-core
    monkeypatch.chdir(_place)
    before = files(_place)
    assert cli.main(shlex.split(command)) == 2
    out, err = capsys.readouterr()
    lines = [each for each in err.splitlines() if not each.startswith("{")]
    assert out == "" and len(lines) == 1 and lines[0].startswith("error: ") and told in lines[0]
    assert files(_place) == before
