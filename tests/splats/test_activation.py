"""Files whose opacities, sizes and colours are activated already: found column by column, and read so."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from splat_ball import ball, equal, plain_ply
from splat_yard import with_up, yard

import fprf
from fprf.cli import main as cli
from fprf.errors import DataError
from fprf.ops.harmonics import HARMONIC
from fprf.splats.activation import Activation
from fprf.splats.files import read_capture, write_capture
from fprf.splats.gaussians import Gaussians


def stored(made: Gaussians, opacities: bool, sizes: bool, white: float) -> Gaussians:
    """The numbers of a file that holds some of them activated."""
    if opacities:
        made = replace(made, logits=made.opacities)
    if sizes:
        made = replace(made, log_scales=made.log_scales.exp())
    if white:
        constants = white * (0.5 + HARMONIC * made.harmonics[:, :1]).clamp(0, 1)
        made = made.recoloured(torch.cat([constants, made.harmonics[:, 1:]], 1))
    return made


def capture_of(path: Path, numbers: Gaussians) -> Path:
    path.write_bytes(plain_ply(numbers))
    return path


@pytest.mark.parametrize("opacities", [False, True])
@pytest.mark.parametrize("sizes", [False, True])
@pytest.mark.parametrize("white", [0.0, 1.0, 255.0])
def test_each_column_is_found_by_itself(opacities: bool, sizes: bool, white: float, tmp_path: Path) -> None:
    made = with_up(yard(2000), "-y")
    path = capture_of(tmp_path / "x.ply", stored(made, opacities, sizes, white))
    plain = read_capture(path)
    assert plain.activation == Activation(opacities, sizes, white)
    assert len(plain.notes) == bool(plain.activation)
    read = read_capture(path, activated=True)
    assert (read.gaussians.logits - made.logits).abs().max() < 1e-5
    assert (read.gaussians.log_scales - made.log_scales).abs().max() < 1e-5
    assert (read.gaussians.colours - made.colours.clamp(0, 1)).abs().max() < 1e-5
    assert len(read.notes) == 1
    # Recoloured in its own format it stays such a file, and all that did not change keeps its bits.
    new = read.gaussians.harmonics.clone()
    new[::2] *= 0.5
    write_capture(tmp_path / "y.ply", read, new)
    again = read_capture(tmp_path / "y.ply", activated=True)
    assert torch.allclose(again.gaussians.harmonics, new, atol=1e-5)
    before = read_capture(tmp_path / "x.ply").gaussians
    after = read_capture(tmp_path / "y.ply").gaussians
    assert equal(before.select(slice(1, None, 2)), after.select(slice(1, None, 2)))
    assert equal(before, after.recoloured(before.harmonics))
    # In another it is written as that format means it.
    write_capture(tmp_path / "z.spz", read, new)
    assert not read_capture(tmp_path / "z.spz").activation


def large(made: Gaussians) -> Gaussians:
    """The capture in millimetres: all sizes above 1."""
    return replace(made, means=1000 * made.means, log_scales=made.log_scales + 6.9)


def flat(made: Gaussians) -> Gaussians:
    scales = made.log_scales.clone()
    scales[:, 2] = -torch.inf
    return replace(made, log_scales=scales)


@pytest.mark.parametrize(
    "made",
    [
        yard(2000),
        ball(2000, degree=2),
        large(yard(2000)),
        flat(yard(2000)),
        replace(yard(2000), logits=torch.linspace(0.2, 9.0, 2000)),
        replace(yard(2000), logits=torch.zeros(2000)),
        replace(yard(2000), log_scales=torch.zeros(2000, 3)),
        yard(2000).recoloured(torch.full((2000, 1, 3), 0.3)),
        yard(2000).recoloured(torch.linspace(0.1, 2.5, 6000).reshape(2000, 1, 3)),
        replace(ball(4), logits=torch.full((4,), 0.5)),
    ],
    ids=["yard", "ball", "mm", "2d", "opaque", "half", "unit", "grey", "bright", "four"],
)
def test_captures_of_raw_numbers_raise_no_alarm(made: Gaussians, tmp_path: Path) -> None:
    capture = read_capture(capture_of(tmp_path / "x.ply", made))
    assert not capture.activation and capture.notes == ()


def test_two_dimensional_gaussians_have_two_sizes(tmp_path: Path) -> None:
    made = yard(500)
    data = plain_ply(stored(made, True, True, 0.0)).replace(b"scale_2", b"other_2")
    (tmp_path / "x.ply").write_bytes(data)
    assert read_capture(tmp_path / "x.ply").activation == Activation(True, True)
    scales = read_capture(tmp_path / "x.ply", activated=True).gaussians.log_scales
    assert torch.allclose(scales[:, :2], made.log_scales[:, :2]) and bool((scales[:, 2] == -torch.inf).all())


def test_numbers_too_large_as_logarithms_are_said_in_the_error(tmp_path: Path) -> None:
    """Sizes in millimetres, of which no logarithm can be drawn."""
    made = large(yard(500))
    made = replace(made, log_scales=made.log_scales + 2.0, means=7 * made.means)
    path = capture_of(tmp_path / "x.ply", stored(made, False, True, 0.0))
    with pytest.raises(DataError, match="--activated true"):
        read_capture(path)
    assert len(read_capture(path, activated=True).gaussians) == 500


def test_a_flag_reads_them_and_doctor_names_them(
    photograph: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = with_up(yard(800), "-y")
    path = capture_of(tmp_path / "x.ply", stored(made, True, True, 255.0))
    raw = capture_of(tmp_path / "raw.ply", made)
    assert cli.main(["doctor", str(path)]) == 1 and "--activated true" in capsys.readouterr().out
    assert cli.main(["doctor", str(raw)]) == 0 and "activated" not in capsys.readouterr().out
    words = ["--references", str(photograph), "--regions", "4", "--views", "4", "--size", "64", "48"]
    words += ["--semantic.encoder", "bundled-semantic", "--cache", str(tmp_path / "cache")]
    assert cli.main(["restyle", str(raw), *words, "--output", str(tmp_path / "wanted.splat")]) == 0
    flags = [*words, "--activated", "true", "--output", str(tmp_path / "out.splat")]
    assert cli.main(["restyle", str(path), *flags]) == 0
    wanted = read_capture(tmp_path / "wanted.splat").gaussians
    found = read_capture(tmp_path / "out.splat").gaussians
    assert (found.colours - wanted.colours).abs().max() < 1.5 / 255
    assert (found.opacities - wanted.opacities).abs().max() < 1.5 / 255
    read = fprf.read(path, activated=True).gaussians
    assert (read.logits - made.logits).abs().max() < 1e-5
