"""Formats of files of Gaussians as plug-ins: a stranger's one file and one entry point are enough for every
reader and verb.
"""

from pathlib import Path

import pytest
import torch
from fake_packages import Packages
from splat_ball import ball

from fprf import testing
from fprf.cli import main as cli
from fprf.errors import DataError
from fprf.page.uploads import check_file, find_source
from fprf.plugins import registry
from fprf.plugins.captures import endings
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.files.base import CaptureFormat, format_of

CODE = '''
"""Means, ln-scales, logits, quaternions and mean colours as rows of float32 behind a word."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fprf.errors import DataError
from fprf.splats.files.base import CaptureFormat
from fprf.splats.files import Capture
from fprf.splats.gaussians import HARMONIC, from_arrays


@dataclass(frozen=True, kw_only=True)
class Toy(CaptureFormat):
    """A stranger's format."""

    view_dependent: ClassVar[bool] = False

    def recognises(self, head, size):
        return head.startswith(b"toy!")

    def read(self, path, data):
        if not self.recognises(data[:4], len(data)) or (len(data) - 4) % 56:
            raise DataError(f"{path}: no toy of whole rows; export it again")
        table = np.frombuffer(data, "<f4", offset=4).reshape(-1, 14)
        colours = (table[:, None, 11:] - 0.5) / HARMONIC

        def recolour(harmonics, changed):
            new = table.copy()
            new[changed, 11:] = 0.5 + HARMONIC * harmonics[changed, 0]
            return [b"toy!", new.tobytes()]

        gaussians = from_arrays(table[:, :3], table[:, 7:11], table[:, 3:6], table[:, 6], colours)
        return Capture(path, gaussians, False, data, recolour)

    def pack(self, gaussians, antialiased, origin):
        parts = (gaussians.means, gaussians.log_scales, gaussians.logits[:, None], gaussians.quaternions, gaussians.colours)
        return [b"toy!", np.concatenate([part.numpy() for part in parts], 1).astype("<f4").tobytes()]
'''


@pytest.fixture
def toy(packages: Packages) -> None:
    packages.install("acme-toy", {"fprf.captures": {"toy": "acme_toy:Toy"}}, code={"acme_toy": CODE})


@pytest.mark.parametrize("name", sorted({*registry.choices("fprf.captures")} - {"usdz"}))  # usdz: an extra
def test_built_in_formats_keep_to_the_contract(name: str) -> None:
    testing.check_capture_format(registry.make("fprf.captures", name, CaptureFormat))


def test_a_strangers_format_is_read_restyled_and_written(toy: None, photograph: Path, tmp_path: Path) -> None:
    testing.check_capture_format(format_of(Path("x.toy")))
    assert ".toy" in endings() and cli.main(["plugins", "--check"]) == 0
    made = ball(300, degree=0)
    path = tmp_path / "in.toy"
    write_gaussians(path, made)
    assert torch.allclose(read_capture(path).gaussians.colours, made.colours, atol=1e-6)
    # The viewer takes it by its name, and by what it begins with.
    assert find_source(path).kind == "capture"
    check_file("x.toy", path.read_bytes()[:64], path.stat().st_size)
    for name, head in (("x.toy", b"other"), ("x.usdz", b"PK\3\4")):  # damaged; a format that is written alone
        with pytest.raises(DataError):
            check_file(name, head, 60)
    words = [
        "restyle",
        str(path),
        "--references",
        str(photograph),
        "--semantic.encoder",
        "bundled-semantic",
        "--regions",
        "3",
    ]
    words += ["--views", "4", "--size", "64", "48", "--cache", str(tmp_path / "cache")]
    assert cli.main([*words, "--output", str(tmp_path / "out.toy")]) == 0
    assert cli.main([*words, "--output", str(tmp_path / "out.ply")]) == 0
    one, other = (read_capture(tmp_path / f"out.{ending}").gaussians for ending in ("toy", "ply"))
    assert torch.equal(one.means, made.means) and torch.allclose(one.colours, other.colours, atol=1e-5)
    assert float((one.colours - made.colours).abs().mean()) > 0.02


def test_a_name_of_no_format_is_refused_with_those_that_there_are(toy: None, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"x\.obj.*\.compressed\.ply.*\.toy"):
        read_capture(tmp_path / "x.obj")
    assert format_of(Path("a.COMPRESSED.ply")) == registry.make(
        "fprf.captures", "compressed.ply", CaptureFormat
    )
    assert format_of(tmp_path / "meta.json") == format_of(Path("x.sog"))
