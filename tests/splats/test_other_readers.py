"""Files of Gaussians held against independent programs: splat-transform (PlayCanvas) and the glTF loader of
three.js.

Both run in Node; their packages are installed once, into the user's cache.
"""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from test_files import cloud
from test_more_formats import covariances, ksplat_of

from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import Gaussians

pytestmark = pytest.mark.slow

SPLAT_TRANSFORM = "3.7.0"
PACKAGES = (f"@playcanvas/splat-transform@{SPLAT_TRANSFORM}", "three@0.187.0")
LOADER = """
import fs from 'fs';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { GLTFGaussianSplatLoaderExtension } from 'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js';
const loader = new GLTFLoader().register(parser => new GLTFGaussianSplatLoaderExtension(parser));
const data = fs.readFileSync(process.argv[2]);
const gltf = await loader.parseAsync(data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength), '');
gltf.scene.updateMatrixWorld(true);
gltf.scene.traverse(object => {
  if (!object.isGaussianSplat) return;
  const found = { matrix: object.matrixWorld.elements };
  for (const [name, values] of Object.entries(object.splatGeometry.attributes)) {
    const bytes = values.array instanceof Uint32Array ? new Uint8Array(values.array.buffer) : values.array;
    found[name] = Array.from(bytes);
  }
  console.log(JSON.stringify(found));
});
"""


@pytest.fixture(scope="session")
def node() -> Path:
    """The folder with the packages."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        pytest.skip("Node and npm are not installed: nothing to hold the files against")
    cache = (
        Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        / "fprf-tests"
        / f"node-{SPLAT_TRANSFORM}"
    )
    cache.mkdir(parents=True, exist_ok=True)
    if not (cache / "node_modules" / "three").is_dir():
        words = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(cache), *PACKAGES]
        installed = subprocess.run(words, check=False, capture_output=True, text=True)
        if installed.returncode:
            pytest.skip(f"{' and '.join(PACKAGES)} cannot be installed: {installed.stderr[-200:]}")
    return cache


@pytest.fixture
def convert(node: Path) -> Callable[[Path, Path], None]:
    """Convert a file by splat-transform."""

    def run(source: Path, target: Path) -> None:
        program = node / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
        subprocess.run(["node", str(program), "-q", "-w", "-g", "cpu", str(source), str(target)], check=True)

    return run


def same(found: Gaussians, wanted: Gaussians, turns: float = 1e-5) -> None:
    """The same Gaussians in any order, their shapes to a share `turns`; what both decode from one file leaves
    no steps.
    """
    assert len(found) == len(wanted) and found.degree == wanted.degree
    wanted = wanted.select(torch.cdist(found.means, wanted.means).argmin(1))
    assert torch.allclose(found.means, wanted.means, atol=1e-6)
    shapes = covariances(found).flatten(1)
    theirs = covariances(wanted).flatten(1)
    assert ((shapes - theirs).norm(dim=1) <= turns * theirs.norm(dim=1)).all()
    assert torch.allclose(found.opacities, wanted.opacities, atol=1e-6)
    assert torch.allclose(found.harmonics, wanted.harmonics, atol=1e-5)


@pytest.mark.parametrize("ending", ["ply", "compressed.ply", "splat", "spz", "sog"])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splat_transform_reads_what_we_write_as_we_do(
    ending: str, degree: int, convert: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    path = tmp_path / f"x.{ending}"
    write_gaussians(path, cloud(degree, 300))
    convert(path, tmp_path / "y.ply")
    # Quaternions of .splat: a byte b is (b - 128) / 128 in the program the format is of, b / 127.5 - 1 there.
    turns = 0.05 if ending == "splat" else 1e-5
    same(read_capture(path).gaussians, read_capture(tmp_path / "y.ply").gaussians, turns)


@pytest.mark.parametrize("ending", ["compressed.ply", "spz", "sog"])
@pytest.mark.parametrize("degree", [0, 3])
def test_we_read_what_splat_transform_writes_as_it_does(
    ending: str, degree: int, convert: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    if ending == "spz":
        pytest.importorskip("zstandard", reason="it writes version 4, which is read with zstandard")
    write_gaussians(tmp_path / "x.ply", cloud(degree, 300))
    convert(tmp_path / "x.ply", tmp_path / f"y.{ending}")
    convert(tmp_path / f"y.{ending}", tmp_path / "z.ply")
    same(read_capture(tmp_path / f"y.{ending}").gaussians, read_capture(tmp_path / "z.ply").gaussians)


@pytest.mark.parametrize("compression", [0, 1, 2])
def test_splat_transform_reads_a_ksplat_as_we_do(
    compression: int, convert: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    made = cloud(2, 75)
    made.harmonics[:, 0] = made.harmonics[:, 0].clamp(-1.7, 1.7)
    (tmp_path / "x.ksplat").write_bytes(ksplat_of(made, compression))
    convert(tmp_path / "x.ksplat", tmp_path / "y.ply")
    same(read_capture(tmp_path / "x.ksplat").gaussians, read_capture(tmp_path / "y.ply").gaussians)


@pytest.mark.parametrize("degree", [0, 3])
def test_the_glb_of_splat_transform_is_the_ply_it_is_made_of(
    degree: int, convert: Callable[[Path, Path], None], tmp_path: Path
) -> None:
    """Turned by 180 degrees about the vertical axis: it takes y of PLY files up by a turn about z, we by one
    about x.
    """
    made = cloud(degree, 300)
    write_gaussians(tmp_path / "x.ply", made)
    convert(tmp_path / "x.ply", tmp_path / "y.glb")
    found = read_capture(tmp_path / "y.glb").gaussians
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    assert torch.allclose(found.means @ turn, made.means, atol=1e-6)
    assert torch.allclose(
        turn.double() @ covariances(found) @ turn.double(), covariances(made), rtol=1e-4, atol=1e-9
    )
    assert torch.allclose(found.opacities, made.opacities, atol=1e-6)
    assert torch.allclose(found.colours, made.colours, atol=1e-6)
    assert torch.allclose(found.harmonics.norm(dim=1), made.harmonics.norm(dim=1), atol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_three_reads_our_glb_as_the_gaussians_it_was_made_of(degree: int, node: Path, tmp_path: Path) -> None:
    """Positions and covariances as floats, colours, opacities and harmonics in the loader's own bytes."""
    made = cloud(degree, 200)
    write_gaussians(tmp_path / "x.glb", made)
    script = node / "read.mjs"
    script.write_text(LOADER)
    shown = subprocess.run(
        ["node", str(script), str(tmp_path / "x.glb")], check=True, capture_output=True, text=True
    )
    found = {name: torch.tensor(values).double() for name, values in json.loads(shown.stdout).items()}
    # Up and towards the viewer in three.js, down and forward in PLY files.
    assert torch.allclose(
        found["matrix"].reshape(4, 4), torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double()), atol=1e-12
    )
    assert torch.allclose(found["position"].reshape(-1, 3), made.means.double(), atol=1e-6)
    rows, columns = torch.triu_indices(3, 3)
    assert torch.allclose(
        found["covariance"].reshape(-1, 6), covariances(made)[:, rows, columns], rtol=1e-4, atol=1e-8
    )
    colours = torch.cat([made.colours.clamp(0, 1), made.opacities[:, None]], 1).double()
    assert (found["color"].reshape(-1, 4) / 255 - colours).abs().max() <= 0.5001 / 255
    start = 1
    for band in range(1, degree + 1):
        count = 2 * band + 1
        bytes_of = found[f"sphericalHarmonics{band}"].reshape(200, -1)[:, : 3 * count]
        wanted = made.harmonics[:, start : start + count].flatten(1).double()
        assert (bytes_of / 128 - 1 - wanted).abs().max() <= 0.5001 / 128
        start += count
