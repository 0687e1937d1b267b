"""Styles on Gaussians: exact where colours are affine, nothing but colours, and the scene itself where
nothing is asked.
"""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from splat_ball import ball

from fprf.cli import main as cli
from fprf.errors import ConfigError, DataError, UsageError
from fprf.interfaces import Encoder
from fprf.ops.harmonics import as_drawn
from fprf.ops.harmonics import spherical_harmonics as functions
from fprf.plugins.encoders.config import BundledSemanticConfig, RandomConfig
from fprf.plugins.stylizers.config import (
    AdainConfig,
    LocalAdainConfig,
    RegionOtConfig,
    RegionToneConfig,
    StylizerConfig,
)
from fprf.rendering.cameras import pixel_grid
from fprf.splats.capture_light import light_alone
from fprf.splats.captures import look_at_capture, open_capture
from fprf.splats.config import LookConfig
from fprf.splats.drawing import draw
from fprf.splats.files import read_capture, write_gaussians
from fprf.splats.gaussians import HARMONIC, Gaussians
from fprf.splats.pinholes import camera_of
from fprf.splats.restyle import all_around
from fprf.splats.scene import SplatScene
from fprf.splats.views import find_views
from fprf.style.config import StyleConfig
from fprf.style.files import StyleFile, write_style
from fprf.style.light import luma
from fprf.style.match_maps import match_map
from fprf.style.restyle import Styled, apply_style

SMALL = ["--views", "4", "--size", "64", "48", "--regions", "3"]
TONE = RegionToneConfig(centred=False)


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return BundledSemanticConfig().build()


@pytest.fixture(scope="module")
def scene(encoder: Encoder) -> SplatScene:
    return look_at_capture(ball(400), False, encoder, LookConfig(views=6, size=(96, 72), regions=4))


def test_views_looked_at_at_once_tell_the_same(scene: SplatScene, encoder: Encoder) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        again = look_at_capture(
            ball(400), False, encoder, LookConfig(views=6, size=(96, 72), regions=4)
        ).found()
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    # The order of float32 sums differs between numbers of threads; features are kept in half precision.
    there = scene.found().features.float()
    assert float((again.features.float() - there).abs().max()) < 2e-3 * float(there.abs().max())


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("photographs")
    draw_ = np.random.default_rng(0)
    paths = []
    for name, low, high in (
        ("dusk", (30, 20, 60), (20, 90, 200)),
        ("snow", (200, 190, 180), (250, 240, 230)),
    ):
        picture = np.concatenate([np.full((60, 160, 3), high), np.full((60, 160, 3), low)]) + draw_.normal(
            0, 12, (120, 160, 3)
        )
        cv2.imwrite(str(folder / f"{name}.png"), picture.clip(0, 255).astype(np.uint8))
        paths.append(folder / f"{name}.png")
    return paths


def applied(scene: SplatScene, *photos: Path, stylizer: StylizerConfig = TONE, **flags: object) -> Styled:
    return apply_style(scene, StyleFile(StyleConfig(references=photos, stylizer=stylizer, **flags)))  # type: ignore[arg-type]


def styled(
    scene: SplatScene, *photos: Path, stylizer: StylizerConfig = TONE, **flags: object
) -> torch.Tensor:
    return scene.restyled(applied(scene, *photos, stylizer=stylizer, **flags).restyle).shown.harmonics


def drawn(scene: SplatScene) -> torch.Tensor:
    """Harmonics of the colours that renderers show of the scene as captured."""
    return as_drawn(scene.gaussians.harmonics, all_around(scene.gaussians.harmonics.shape[1]))


def uncut(harmonics: torch.Tensor) -> torch.Tensor:
    """Gaussians whose mean colours lie within [0, 1]."""
    return (HARMONIC * harmonics[:, 0]).abs().amax(1) < 0.499


@pytest.mark.parametrize(
    "stylizer", [TONE, RegionOtConfig(), AdainConfig(), LocalAdainConfig()], ids=lambda s: type(s).__name__
)
def test_a_style_is_one_affine_map_of_what_is_seen(
    scene: SplatScene, photographs: list[Path], stylizer: StylizerConfig
) -> None:
    """Seen from anywhere, the new colour of a Gaussian is an affine function of its old one."""
    new = styled(scene, *photographs, stylizer=stylizer)
    around = torch.nn.functional.normalize(
        torch.randn(64, 3, generator=torch.Generator().manual_seed(1)), dim=1
    )
    basis = functions(around, 2)
    old, now = (torch.einsum("db,nbc->ndc", basis, each).double() for each in (drawn(scene), new))
    inside = uncut(new)
    assert int(inside.sum()) > 20
    for k in inside.nonzero()[:20, 0].tolist():
        plus = torch.cat([old[k], torch.ones(64, 1, dtype=torch.float64)], 1)
        # In float64: of some Gaussians the old colours lie in a plane, which float32 solves or not by its
        # last bit.
        left = now[k] - plus @ torch.linalg.lstsq(plus, now[k]).solution
        assert left.abs().max() < 1e-4 and (now[k] - old[k]).abs().max() > 1e-3


def test_at_strength_0_and_in_kept_regions_nothing_changes(
    scene: SplatScene, photographs: list[Path]
) -> None:
    before = scene.gaussians.harmonics
    assert torch.equal(styled(scene, photographs[0], strength=0.0), before)
    everything = tuple(str(k) for k in range(len(scene.measured()[0].share)))
    assert torch.equal(styled(scene, photographs[0], keep=everything), before)
    full, half = (styled(scene, photographs[0], strength=s) for s in (1.0, 0.5))
    free = uncut(full)
    assert int(free.sum()) > 50 and torch.allclose(half[free], (full + drawn(scene))[free] / 2, atol=1e-5)
    one = styled(scene, photographs[0], keep=everything[1:])
    changed = (one != before).flatten(1).any(1)
    assert changed.any() and not changed.all() and not torch.equal(one, full)


def test_pinned_regions_and_places_take_one_photograph_alone(
    scene: SplatScene, photographs: list[Path]
) -> None:
    regions = range(len(scene.measured()[0].share))
    snow, dusk = (
        styled(scene, *photographs, pin=tuple(f"{k}={name}" for k in regions)) for name in ("snow", "dusk")
    )
    free = styled(scene, *photographs)
    alone = styled(scene, photographs[1])
    assert torch.allclose(snow, alone, atol=1e-4) and (free - alone).abs().max() > 0.01
    with pytest.raises(UsageError, match="region 9"):
        styled(scene, photographs[0], keep=("9",))
    means = scene.gaussians.means
    for place, border, from_axis in (
        ("box:-0.3,-9,-9:0.3,9,9:0.4", 0.4, means[:, 0].abs()),
        ("path:0,-9,0:0,9,0:0.6,0.4", 0.4, means[:, [0, 2]].norm(dim=1)),
        ("box:0.3,-9,-9:-0.3,9,9", 0.0, means[:, 0].abs()),
    ):
        both = styled(scene, *photographs, pin=("everywhere=dusk", f"{place}=snow"))
        inside = from_axis <= 0.3
        outside = from_axis >= 0.3 + border
        assert inside.any() and outside.any() and (from_axis - 0.3).abs().min() > 1e-6
        assert torch.equal(both[inside], snow[inside]) and torch.equal(both[outside], dusk[outside])
        # Between both, the nearer to the place, the more of its style.
        share = (both - dusk).flatten(1).norm(dim=1) / (snow - dusk).flatten(1).norm(dim=1)
        edge = ~inside & ~outside & uncut(both)
        assert (
            bool((share[edge][from_axis[edge].argsort()].diff() < 0.02).all())
            and int(edge.sum()) >= 100 * border
        )
    elsewhere = styled(scene, *photographs, pin=(f"{place}=snow",))
    assert torch.equal(elsewhere[outside], free[outside])


def test_maps_of_matches_heed_places(scene: SplatScene, photographs: list[Path]) -> None:
    found = applied(scene, *photographs, pin=("everywhere=snow",))
    taken = match_map(scene, found, 0).taken
    dusk = found.codes.reference == found.codes.names.index("dusk.png")
    assert float(taken[..., dusk].abs().max()) == 0 and float(taken.sum(-1).max()) > 0.99
    view = scene.cached(scene.cameras, 0)
    assert torch.allclose(view.paint(found.restyle.match), taken.flatten(0, 1), atol=1e-6)


def test_painting_takes_bounded_memory_and_changes_nothing(
    scene: SplatScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def values(semantic: torch.Tensor, points: torch.Tensor | None) -> torch.Tensor:
        asked.append(len(semantic))
        return semantic[:, :3].repeat(1, 7)

    whole, opacity = scene.paint(scene.cameras, 0, pixel_grid(scene.cameras, 0), values)
    monkeypatch.setattr("fprf.splats.scene._PAINTED_GAUSSIANS", 64)
    monkeypatch.setattr("fprf.splats.scene._PAINTED_CHANNELS", 8)
    asked.clear()
    parts, same = scene.paint(scene.cameras, 0, pixel_grid(scene.cameras, 0), values)
    assert max(asked) == 64 and torch.equal(parts, whole) and torch.equal(opacity, same)


@pytest.mark.parametrize(
    "place", ["box:1,2:3", "box:1,2,3:4,5,nan", "path:0,0,0:1,1,1", "path:0,0,0:1,1,1:-1"]
)
def test_a_malformed_place_is_refused(place: str) -> None:
    with pytest.raises(ConfigError):
        StyleConfig(pin=(f"{place}=snow.png",))


def test_luminance_is_kept_and_styles_mix(scene: SplatScene, photographs: list[Path], tmp_path: Path) -> None:
    tinted = styled(scene, photographs[0], luminance=1.0)
    free = uncut(tinted)
    change = HARMONIC * (tinted - drawn(scene))[:, 0]
    assert int(free.sum()) > 100 and luma(change)[free].abs().max() < 1e-4
    write_style(tmp_path / "style.json", StyleFile(StyleConfig(references=(photographs[1],), stylizer=TONE)))
    a, b = (styled(scene, photo) for photo in photographs)
    mixed = styled(scene, photographs[0], between=tmp_path / "style.json", at=0.25)
    free = uncut(mixed) & uncut(a) & uncut(b)
    assert int(free.sum()) > 50 and torch.allclose(mixed[free], (0.75 * a + 0.25 * b)[free], atol=1e-4)


def test_light_alone_counts_photographs_by_their_weights(scene: SplatScene, photographs: list[Path]) -> None:
    both = applied(scene, *photographs, weights=(1e-6, 1.0))
    snow = applied(scene, photographs[1])
    maps, alone = (light_alone(each).restyle.colours for each in (both, snow))
    assert maps is not None and alone is not None and torch.allclose(maps.matrix, alone.matrix, atol=1e-4)


def test_what_the_cache_knows_of_a_capture_gives_the_same_colours(
    photographs: list[Path], tmp_path: Path
) -> None:
    write_gaussians(tmp_path / "a.ply", ball(400))
    capture = read_capture(tmp_path / "a.ply")
    look = LookConfig(views=6, size=(96, 72), regions=4)
    said = list[str]()
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "gone.safetensors").symlink_to("removed")  # as another process has it
    first = styled(open_capture(capture, look, cache=tmp_path / "cache"), photographs[0])
    (kept,) = (path for path in (tmp_path / "cache").iterdir() if path.is_file())
    for damaged in (False, True):
        if damaged:
            kept.write_bytes(kept.read_bytes()[:-1])
        again = open_capture(capture, look, cache=tmp_path / "cache", say=said.append)
        assert torch.equal(styled(again, photographs[0]), first)
        assert any("again" in each for each in said) == damaged


def test_a_capture_is_restyled_alike_where_nothing_can_be_cached(
    photographs: list[Path], tmp_path: Path
) -> None:
    write_gaussians(tmp_path / "a.ply", ball(400))
    (tmp_path / "file").touch()
    capture = read_capture(tmp_path / "a.ply")
    look = LookConfig(views=6, size=(96, 72), regions=4)
    here = styled(open_capture(capture, look, cache=tmp_path / "cache"), photographs[0])
    assert torch.equal(styled(open_capture(capture, look, cache=tmp_path / "file/x"), photographs[0]), here)


def test_objects_are_seen_from_around_and_rooms_from_within() -> None:
    seen = find_views(ball(400), LookConfig(views=8, size=(64, 48)))
    assert len(seen) == 8 and (seen.pose[:, :, 3].norm(dim=1) > 1.2).all()
    assert (seen.pose[:, 1, 1] < 0).all(), "upright: the camera's up is -y"
    # A room: a closed box of flat Gaussians, seen from within.
    side = torch.linspace(-1, 1, 24)
    half = torch.tensor([3.0, 1.0, 2.0])
    end = torch.tensor([-1.0, 1.0])
    walls = [
        half * torch.cartesian_prod(*(end if k == axis else side for k in range(3))) for axis in range(3)
    ]
    table = 0.3 * torch.randn(5000, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor(
        [0.0, 0.7, 0.0]
    )
    means = torch.cat([*walls, table.clamp_max(1.0)])
    count = len(means)
    flat = torch.full((count, 3), -2.0)
    opaque = torch.full((count,), 4.0)
    flat[-5000:] = -4.0  # near things are finer
    room = Gaussians(means, torch.eye(4)[:1].expand(count, 4), flat, opaque, torch.zeros(count, 1, 3))
    within = find_views(room, LookConfig(views=8, size=(64, 48)))
    assert (within.pose[:, :, 3].abs() < half).all()
    assert all(float(draw(room, camera_of(within, v)).opacity.mean()) > 0.95 for v in range(len(within)))
    # A hollow object is as closed as a room.
    for given, inside in ((room.select(slice(-5000)), None), (room, False)):
        outside = find_views(given, LookConfig(views=8, size=(64, 48), inside=inside))
        assert not (outside.pose[:, :, 3].abs() < half).all(1).any()
    one = replace(ball(200), means=torch.zeros(200, 3), log_scales=torch.zeros(200, 3))
    assert len(find_views(one, LookConfig(views=2, size=(64, 48)))) == 2, "all in one place, of one size"
    few = room.select(slice(4))
    with pytest.raises(DataError):
        find_views(
            replace(few, log_scales=few.log_scales - 30, logits=few.logits - 30),
            LookConfig(views=2, size=(64, 48)),
        )


def test_views_stand_where_the_sizes_of_gaussians_say_that_photographs_were_taken() -> None:
    # A frontal scene in a sphere of surroundings; Gaussians look equally large from (4, 1, -3).
    draws = torch.Generator().manual_seed(0)
    place = torch.tensor([4.0, 1.0, -3.0])
    count = 3000
    front = torch.rand(count, 3, generator=draws) * torch.tensor([4.0, 3.0, 5.0]) + torch.tensor(
        [2.0, -0.5, 0.0]
    )
    sphere = place + 60 * torch.nn.functional.normalize(torch.randn(300, 3, generator=draws), dim=1)
    means = torch.cat([front, sphere])
    size = ((means - place).norm(dim=1) * 0.02).log() + 0.2 * torch.randn(len(means), generator=draws)
    size[count:] += 2
    turn = torch.nn.functional.normalize(torch.randn(len(means), 4, generator=draws), dim=1)
    scene = Gaussians(
        means, turn, size[:, None].expand(-1, 3).clone(), torch.full((len(means),), 3.0), means[:, None] * 0
    )
    seen = find_views(scene, LookConfig(views=12, size=(64, 48)))
    eye = seen.pose[:, :, 3]
    ahead = -seen.pose[:, :, 2]
    assert float((eye - place).norm(dim=1).median()) < 3
    to_middle = torch.nn.functional.normalize(torch.tensor([4.0, 1.0, 2.5]) - eye, dim=1)
    assert float((ahead * to_middle).sum(1).median()) > 0.8
    assert all(float(draw(scene, camera_of(seen, v)).opacity.mean()) > 0.7 for v in range(len(seen)))


def restyled(folder: Path, photographs: list[Path]) -> list[str]:
    """Words of the command for a capture in.ply, with a cache, without an output."""
    kept = ["--cache", str(folder / "cache")]
    return ["restyle", str(folder / "in.ply"), *SMALL, *kept, "--references", *map(str, photographs)]


def test_the_verb_writes_capture_page_and_style(
    photographs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = ball(200)
    made.means[7, 0] = torch.nan
    write_gaussians(tmp_path / "in.ply", made)
    words = restyled(tmp_path, photographs)
    endings = {"--output": "ply", "--page": "html"}
    outputs = [word for flag, ending in endings.items() for word in (flag, str(tmp_path / f"out.{ending}"))]
    assert cli.main([*words, "--each", "true", *outputs, "--explain", "true"]) == 0
    said = capsys.readouterr().out
    assert "1 that are not finite left as they are" in said and "region  share" in said
    first, second = (read_capture(tmp_path / f"out-{name}.ply").gaussians for name in ("dusk", "snow"))
    assert torch.equal(first.log_scales, made.log_scales) and torch.equal(
        first.harmonics[7], made.harmonics[7]
    )
    assert second.colours.nanmean() > first.colours.nanmean() + 0.1, "snow is brighter than dusk"
    assert "dusk" in (tmp_path / "out.html").read_text()
    assert len(list((tmp_path / "cache").glob("*.safetensors"))) == 1
    again = ["--style", str(tmp_path / "out-dusk.style.json"), "--output", str(tmp_path / "again.ply")]
    assert cli.main([*words[: words.index("--references")], *again]) == 0
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "out-dusk.ply").read_bytes()
    same = ["--strength", "0", "--output", str(tmp_path / "same.ply")]
    assert cli.main([*words, *same]) == 0
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    kept = next((tmp_path / "cache").glob("*.safetensors"))
    kept.write_bytes(kept.read_bytes()[:-9])
    assert cli.main([*words, *same]) == 0, "what is damaged is made again"


def test_a_page_needs_no_photographs_where_a_light_is_named(photographs: list[Path], tmp_path: Path) -> None:
    write_gaussians(tmp_path / "in.ply", ball(200))
    words = restyled(tmp_path, photographs[:1])
    for name, flags in (("lit", words[: words.index("--references")]), ("both", words)):
        page = tmp_path / f"{name}.html"
        assert cli.main([*flags, "--light", "golden-hour", "--page", str(page)]) == 0
        written = page.read_text()
        assert "golden-hour" in written and (photographs[0].stem in written) == (name == "both")


def test_any_encoder_finds_the_regions(photographs: list[Path], tmp_path: Path) -> None:
    """Also those of other packages: the slot is that of fields. What each found is kept beside what others
    did.
    """
    write_gaussians(tmp_path / "in.ply", ball(200))
    words = restyled(tmp_path, photographs)
    random = ["--semantic.encoder", "random", "--semantic.encoder.channels", "6"]
    for name, flags in (("bundled", []), ("random", random), ("again", random)):
        assert cli.main([*words, *flags, "--output", str(tmp_path / f"{name}.ply")]) == 0
    assert len(list((tmp_path / "cache").glob("*.safetensors"))) == 2
    bundled, other, again = (
        (tmp_path / f"{name}.ply").read_bytes() for name in ("bundled", "random", "again")
    )
    assert other == again != bundled
    known = json.loads((tmp_path / "random.style.json").read_text())
    assert known["semantic_encoder"] == RandomConfig(channels=6).build().identity
