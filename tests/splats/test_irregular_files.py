"""Captures as people have them: rows that cannot be drawn, outliers, few Gaussians, large coordinates, other
units.
"""

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from moved_scene import UTM
from splat_ball import ball, plain_ply

from fprf.errors import DataError
from fprf.plugins.encoders.config import BundledSemanticConfig
from fprf.rendering.local_frame import offset_file, read_offset
from fprf.splats.captures import look_at_capture
from fprf.splats.config import LookConfig
from fprf.splats.drawing import clip_distance, draw, seen_means
from fprf.splats.files import Capture, Written, read_capture, write_capture, write_gaussians
from fprf.splats.gaussians import GaussianRows, Gaussians
from fprf.splats.pinholes import camera_of
from fprf.splats.views import find_views

# How far positions in a unit ball and ln-scales from -6 to -1 may move.
STEPS = {
    ".ply": (0.0, 0.0),
    ".compressed.ply": (1.5e-3, 0.02),
    ".splat": (0.0, 1e-6),
    ".spz": (2**-12, 1 / 32),
    ".sog": (2e-4, 0.03),
}
BAD: dict[str, Callable[[Gaussians, int], None]] = {
    "NaN": lambda g, i: g.means[i].fill_(torch.nan),
    "infinite": lambda g, i: g.means[i, :1].fill_(-torch.inf),
    "endless": lambda g, i: g.log_scales[i, 1:2].fill_(torch.inf),
    "unrotated": lambda g, i: g.quaternions[i].fill_(0),
    "zeros": lambda g, i: [part[i].fill_(0) for part in vars(g).values()] and None,
    "black hole": lambda g, i: g.harmonics[i, 0, :1].fill_(torch.nan),
}


def capture_of(folder: Path, gaussians: Gaussians) -> Capture:
    (folder / "in.ply").write_bytes(plain_ply(gaussians))
    return read_capture(folder / "in.ply")


def converted(capture: Capture, path: Path) -> tuple[Gaussians, Written]:
    written = write_capture(path, capture, capture.gaussians.harmonics)
    return read_capture(path).gaussians, written


def errors(of: Gaussians, found: Gaussians) -> tuple[float, float]:
    """Largest errors of positions and ln-scales: each Gaussian against the nearest that was found."""
    apart = torch.cdist(
        of.means.double(), found.means.double(), p=torch.inf, compute_mode="donot_use_mm_for_euclid_dist"
    )
    nearest = apart.argmin(1)
    assert len(nearest.unique()) == len(of), "each is there"
    scales = (found.log_scales[nearest] - of.log_scales).abs().nan_to_num(0, 0)
    return float(apart.amin(1).max()), float(scales.max())


def test_rows_that_cannot_be_drawn_stay_as_they_are_in_their_format(tmp_path: Path) -> None:
    made = ball(12 * len(BAD))
    for i, spoil in enumerate(BAD.values()):
        spoil(made, 7 * i)
    capture = capture_of(tmp_path, made)
    new = capture.gaussians.harmonics + 0.1
    write_capture(tmp_path / "out.ply", capture, new[capture.gaussians.finite])
    before, after = (np.frombuffer(each[each.index(b"end_header\n") + 11 :], "<f4").reshape(len(made), -1)
                     for each in (capture.data, (tmp_path / "out.ply").read_bytes()))  # fmt: skip
    same = (before.view("<u4") == after.view("<u4")).all(1)
    assert np.array_equal(same, ~capture.gaussians.finite.numpy())
    assert np.array_equal(before.view("<u4")[:, :6], after.view("<u4")[:, :6])


@pytest.mark.parametrize("ending", STEPS)
def test_flat_gaussians_are_drawn_and_spoil_no_sizes(ending: str, tmp_path: Path) -> None:
    made = ball(400)
    made.log_scales[::2, 2] = -torch.inf
    capture = capture_of(tmp_path, made)
    found, written = converted(capture, tmp_path / f"out{ending}")
    assert bool(capture.gaussians.finite.all()) and len(found) == 400 and written == Written()
    position, scale = errors(made, found)
    assert position <= STEPS[ending][0] + 1e-7 and scale <= STEPS[ending][1] + 1e-6
    nearest = torch.cdist(made.means.double(), found.means.double()).argmin(1)
    assert (found.log_scales[nearest[::2], 2] <= -9.9).all()
    drawable = capture.gaussians.drawable()
    views = find_views(drawable, LookConfig(views=3, size=(64, 48)))
    thin = Gaussians(**(vars(made) | {"log_scales": made.log_scales.clamp_min(-14)}))
    shown, wanted = (draw(each, camera_of(views, 0)).image for each in (drawable, thin))
    assert wanted.amax() > 0.4 and (shown - wanted).abs().max() < 1e-3


def test_surroundings_and_object_keep_their_precision(tmp_path: Path) -> None:
    """Surroundings 30 times as far as the object stay where they are, and so does the object."""
    made = ball(3000)  # 2500 of the object: the last of their chunks has room for 60
    sky = torch.nn.functional.normalize(torch.randn(500, 3), dim=1) * 30
    made.means[:500] = sky
    found, written = converted(capture_of(tmp_path, made), tmp_path / "out.compressed.ply")
    assert written == Written() and len(found) == 3060
    assert int((found.opacities < 1e-5).sum()) == 60, "filled up with transparent ones"
    assert errors(made.select(slice(500, None)), found.select(found.means.norm(dim=1) < 2))[0] < 1.5e-3
    far = found.select(found.means.norm(dim=1) > 2)
    assert (torch.cdist(far.means, sky).amin(1) < 60 / 1023).all()
    for ending in (".spz", ".sog"):
        assert converted(capture_of(tmp_path, made), tmp_path / f"out{ending}")[1] == Written()


SPOILED = st.lists(
    st.tuples(st.integers(0, 299), st.sampled_from([*BAD, "far", "huge", "bright", "flat"])), max_size=20
)


@settings(max_examples=25)
@given(SPOILED, st.floats(2, 14), st.sampled_from(list(itertools.permutations(STEPS, 2))))
def test_the_others_survive_any_mixture_of_bad_rows_between_any_two_formats(
    tmp_path: Path, spoiled: list[tuple[int, str]], power: float, endings: tuple[str, str]
) -> None:
    made = ball(300, seed=1)
    whole = ball(300, seed=1)
    sound = torch.ones(300, dtype=torch.bool)
    for i, fault in spoiled:
        sound[i] = False
        if fault == "far":
            made.means[i, i % 3] = (-1) ** i * 10**power
        elif fault == "huge":
            made.log_scales[i] = 60.0
        elif fault == "bright":
            made.harmonics[i] = 10**power
        elif fault == "flat":
            made.log_scales[i, i % 3] = -torch.inf
        else:
            BAD[fault](made, i)
    capture = capture_of(tmp_path, made)
    drawn = capture.gaussians.finite
    once = [i for i, fault in spoiled if fault in BAD and sum(i == k for k, _ in spoiled) == 1]
    assert bool(drawn[sound].all()) and not drawn[once].any()
    for ending in endings:
        path = tmp_path / f"between{ending}"
        written = write_capture(path, capture, capture.gaussians.harmonics)
        assert written.faulty or ending == ".ply" or bool(capture.gaussians.finite.all()), (
            "what is left out is said"
        )
        capture = read_capture(path)
    found = capture.gaussians.select((capture.gaussians.means.abs() < 3).all(1) & capture.gaussians.finite)
    position, scale = errors(whole.select(sound), found)
    assert position <= sum(STEPS[each][0] for each in endings) + 1e-6
    assert scale <= sum(STEPS[each][1] for each in endings) + 1e-5
    nearest = torch.cdist(whole.means[sound].double(), found.means.double()).argmin(1)
    assert (found.colours[nearest].clamp(0, 1) - whole.colours[sound].clamp(0, 1)).abs().max() < 0.03


def test_sizes_beyond_those_of_spz_are_said(tmp_path: Path) -> None:
    small = ball(200)
    small = Gaussians(
        small.means * 1e-3, small.quaternions, small.log_scales - 9, small.logits, small.harmonics
    )
    assert converted(capture_of(tmp_path, small), tmp_path / "out.spz")[1].notes[0].startswith("200 ")


def test_colours_of_bytes_and_flat_gaussians_are_read_and_recoloured_in_place(tmp_path: Path) -> None:
    made = ball(30, degree=0)
    made.harmonics[:, 0] = torch.linspace(-1, 1, 90).view(30, 3)
    columns = np.frombuffer(plain_ply(made).partition(b"end_header\n")[2], "<f4").reshape(30, 17)
    names = [
        *"xyz",
        "nx",
        "ny",
        "nz",
        "red",
        "green",
        "blue",
        "opacity",
        "scale_0",
        "scale_1",
        *(f"rot_{i}" for i in range(4)),
    ]
    kinds = [(name, "u1" if name in ("red", "green", "blue") else "<f4") for name in names]
    columns = np.delete(columns, 12, 1)
    columns[:, 6:9] = np.rint(255 * made.colours.numpy())
    rows = np.rec.fromarrays(columns.T, dtype=np.dtype(kinds))
    lines = ["ply", "format binary_little_endian 1.0", "comment SplatRenderMode: 2dgs", "element vertex 30"]
    lines += [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in kinds]
    data = "\n".join([*lines, "end_header", ""]).encode() + rows.tobytes()
    (tmp_path / "x.ply").write_bytes(data)
    capture = read_capture(tmp_path / "x.ply")
    assert (capture.gaussians.colours - made.colours).abs().max() <= 0.5 / 255 + 1e-6
    assert torch.equal(capture.gaussians.log_scales[:, :2], made.log_scales[:, :2])
    assert bool((capture.gaussians.log_scales[:, 2] == -torch.inf).all()) and bool(
        capture.gaussians.finite.all()
    )
    write_capture(tmp_path / "y.ply", capture, capture.gaussians.harmonics * 0.5)
    new = (tmp_path / "y.ply").read_bytes()
    apart = np.frombuffer(new, np.uint8).astype(int) - np.frombuffer(data, np.uint8)
    assert len(new) == len(data) and 60 < np.count_nonzero(apart) <= 90, "bytes of colours alone"
    again = read_capture(tmp_path / "y.ply").gaussians
    assert (again.harmonics - capture.gaussians.harmonics * 0.5).abs().max() <= 0.5 / 255 / 0.28


def few(name: str) -> Gaussians:
    made = ball(1 if name == "one" else 2 if name == "two" else 150)
    if name == "together":
        made.means[:] = 0.5
    elif name == "plane":
        made.means[:, 2] = 0.0
    elif name == "needles":
        made.log_scales[:, 1:] = -torch.inf
    elif name == "line":
        made.means[:, 1:] = 0.0
    return made


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["one", "two", "together", "plane", "line", "needles"])
def test_few_gaussians_and_those_in_a_plane_are_looked_at(name: str, tmp_path: Path) -> None:
    made = few(name)
    drawable = made.drawable()
    scene = look_at_capture(
        drawable, False, BundledSemanticConfig().build(), LookConfig(views=4, size=(64, 48), regions=3)
    )
    assert bool(scene.views.pose.isfinite().all()) and bool(scene.found().features.isfinite().all())
    opacity = torch.stack(
        [draw(drawable, camera_of(scene.views, v)).opacity.mean() for v in range(len(scene.views))]
    )
    assert opacity.max() > (0.002 if name == "needles" else 0.02)
    for ending in STEPS:
        found, written = converted(capture_of(tmp_path, made), tmp_path / f"out{ending}")
        assert len(found) == len(made) and written == Written()
        apart = torch.cdist(made.means.double(), found.means.double(), p=torch.inf)
        assert apart.amin(1).max() <= STEPS[ending][0] + 1e-6


def test_a_capture_of_which_nothing_is_left_is_refused(tmp_path: Path) -> None:
    made = ball(5)
    made.quaternions[:] = 0
    with pytest.raises(DataError):
        capture_of(tmp_path, made)
    with pytest.raises(DataError):
        capture_of(tmp_path, ball(5).select(slice(0)))
    rounded = ball(200)
    rounded.means[:, 1] += 1e7  # where float32 has steps of its size
    with pytest.raises(DataError):
        capture_of(tmp_path, rounded)


def test_stray_gaussians_decide_neither_views_nor_semantics() -> None:
    made = ball(400)
    look = LookConfig(views=4, size=(64, 48), regions=3)
    stray = ball(400)
    stray.means[7] = torch.tensor([3e4, -2e5, 1e5])
    first, second = (
        look_at_capture(each, False, BundledSemanticConfig().build(), look) for each in (made, stray)
    )
    away = [each.views.pose[:, :, 3].norm(dim=1) for each in (first, second)]
    assert torch.allclose(away[0].mean(), away[1].mean(), rtol=0.05)
    # Regions are numbered as they come.
    shares = [each.found().style.share.sort().values for each in (first, second)]
    assert torch.allclose(shares[0], shares[1], atol=0.1)


ENDINGS = {"ply": 1e-6, "splat": 1e-6, "spz": 2e-6, "sog": 1e-4, "compressed.ply": 2e-3}
"""Formats, and the errors of positions that their bits leave in a ball of radius 1."""


def in_world(path: Path) -> np.ndarray:
    """Positions of a file less UTM, in an order of their own: float64."""
    capture = read_capture(path)
    return capture.gaussians.means.double().numpy() + (np.array(capture.origin) - UTM)


def nearest(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest distance from a position to the nearest wanted one."""
    return float(np.linalg.norm(found[:, None] - wanted[None], axis=2).min(1).max())


@pytest.mark.parametrize("local", [False, True])
@pytest.mark.parametrize("ending", ENDINGS)
def test_positions_come_back_from_every_format(tmp_path: Path, ending: str, local: bool) -> None:
    made = ball(300)
    path = tmp_path / f"a.{ending}"
    write_gaussians(path, made, origin=UTM, local=local)
    assert nearest(in_world(path), made.means.double().numpy()) < ENDINGS[ending]
    world = ending == "ply" and not local
    assert read_offset(path) == ((0, 0, 0) if world else UTM)
    if ending == "ply":
        assert (b"property double x" in path.read_bytes()) == world
        place = trimesh.load(path).vertices - (UTM if world else (0, 0, 0))  # by another reader
        assert np.abs(place - made.means.numpy()).max() < 2e-9


def test_parts_of_a_large_file_are_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fprf.splats.files.base.ROWS", 16)
    made = ball(50)
    for local in (False, True):
        write_gaussians(tmp_path / "a.ply", made, origin=UTM, local=local)
        write_gaussians(tmp_path / "b.ply", GaussianRows(50, made.select, False), origin=UTM, local=local)
        assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
        assert (
            read_offset(tmp_path / "a.ply")
            == read_offset(tmp_path / "b.ply")
            == (UTM if local else (0, 0, 0))
        )
    write_gaussians(tmp_path / "c.ply", made)
    assert (tmp_path / "c.ply").read_bytes() == plain_ply(made), "float32 where there is no origin"


def test_float32_positions_far_from_0_are_looked_at_about_their_middle(tmp_path: Path) -> None:
    """As other programs wrote them: what they rounded stays rounded, and nothing more."""
    made = ball(200)
    far = replace(made, means=made.means * 1000 + 1e7)
    write_gaussians(tmp_path / "far.ply", far)
    capture = read_capture(tmp_path / "far.ply")
    assert capture.gaussians.means.abs().max() < 2000 and capture.offset == (0, 0, 0) != capture.shift
    world = capture.gaussians.means.double() + torch.tensor(capture.origin, dtype=torch.float64)
    assert torch.equal(world, far.means.double())


def test_what_is_written_again_keeps_its_place(tmp_path: Path) -> None:
    made = ball(200)
    write_gaussians(tmp_path / "in.ply", made, origin=UTM)
    write_gaussians(tmp_path / "in.splat", made, origin=UTM)
    for name in ("in.ply", "in.splat"):
        capture = read_capture(tmp_path / name)
        new = capture.gaussians.harmonics + 0.1
        for ending in ENDINGS:
            write_capture(tmp_path / f"out.{ending}", capture, new)
            assert (
                nearest(in_world(tmp_path / f"out.{ending}"), made.means.double().numpy()) < ENDINGS[ending]
            )
        ending = name.partition(".")[2]
        write_capture(tmp_path / f"same.{ending}", capture, capture.gaussians.harmonics)
        assert (tmp_path / f"same.{ending}").read_bytes() == (tmp_path / name).read_bytes()
        assert offset_file(tmp_path / f"same.{ending}").exists() == (name == "in.splat")
    (tmp_path / "folder.splat").mkdir()
    with pytest.raises(DataError):
        write_gaussians(tmp_path / "folder.splat", made, origin=UTM)
    assert not offset_file(tmp_path / "folder.splat").exists(), (
        "nothing is said of a file that was not written"
    )


def scaled(gaussians: Gaussians, factor: float) -> Gaussians:
    return replace(
        gaussians, means=gaussians.means * factor, log_scales=gaussians.log_scales + float(np.log(factor))
    )


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_in_other_units_the_same_is_seen(factor: float) -> None:
    own = ball(300)
    other = scaled(ball(300), factor)
    views = [find_views(each, LookConfig(views=4, size=(48, 36), inside=False)) for each in (own, other)]
    assert torch.allclose(
        views[0].pose[:, :, 3] * factor, views[1].pose[:, :, 3], rtol=1e-4, atol=1e-4 * factor
    )
    assert torch.allclose(views[0].pose[:, :, :3], views[1].pose[:, :, :3], atol=1e-5)
    first, second = (
        seen_means(each, shown, antialiased=True) for each, shown in zip((own, other), views, strict=True)
    )
    assert torch.allclose(first.opacities, second.opacities, atol=1e-3)
    assert clip_distance(own) == 0.01 and 5e-5 < clip_distance(other) / factor < 0.03
