"""The light of a page: a day, and what Gaussians receive, in bytes."""

import itertools
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pages import page_of, seen, street
from splat_ball import ball

from fprf.errors import ConfigError
from fprf.io.images import srgb_to_linear
from fprf.light.config import SunConfig
from fprf.light.day import check_suns, day
from fprf.light.relight import LINEAR_OFFSET, encoded, level_share, sky_share, sun_share
from fprf.page.suns import packed_day, packed_light, packed_surfaces, surfaces_header
from fprf.page.writer import page_html
from fprf.splats.scene import SplatScene

NOON = SunConfig(sun=(70.0, 40.0))
HALF_STEP = 0.5 / 255


@pytest.fixture(scope="module")
def scene() -> SplatScene:
    """A street, with things far away and a sky."""
    return seen(street(2000))


def test_bytes_are_within_half_a_step_of_what_they_stand_for(scene: SplatScene) -> None:
    known = scene.light_found
    assert bool(known.sky.any()) and not bool(known.sky.all())
    _, sun, received = known.under(NOON)
    level, opened = packed_surfaces(known) / 255
    thing = ~known.sky.numpy()
    assert (np.abs(opened - sky_share(received).numpy())[thing] <= HALF_STEP + 1e-6).all()
    assert (opened[~thing] == 0).all() and (opened[thing] > 0.1).all()
    facing = level_share(received, known.up).numpy()
    assert (np.abs(level - facing)[thing] <= HALF_STEP + 1e-6).all()
    assert (np.abs(level - known.heights.numpy())[~thing] <= HALF_STEP + 1e-6).all()
    met = packed_light(known, NOON).met
    assert met is not None
    assert (np.abs(met / 255 - sun_share(received, sun).numpy()) <= HALF_STEP + 1e-6).all()


def test_clouds_and_blue_take_one_hue_under_clouds_and_stay_in_the_sun(scene: SplatScene) -> None:
    known = scene.light_found
    colours = known.colours.clone()
    rows = known.sky.nonzero()[:, 0]
    colours[rows] = torch.tensor([0.25, 0.45, 0.85])
    clouds = rows[::5]
    colours[clouds] = torch.tensor([0.85, 0.87, 0.9])
    blue = replace(known, colours=colours)

    def hue(light: str, which: torch.Tensor) -> torch.Tensor:
        gain = blue.gain(SunConfig(light=light))  # type: ignore[arg-type]
        lit = (gain * (colours + LINEAR_OFFSET)).pow(2.4)[which]
        return lit / lit.mean(1, keepdim=True)

    # Of the sky's colours, as captured, those of the hue of clouds stay them, and their brightness alone tells them apart.
    grey = hue("overcast", rows)
    assert float((grey - grey.mean(0)).abs().max()) < 0.02 and float((grey.mean(0) - 1).abs().max()) < 0.02
    captured = (colours + LINEAR_OFFSET).pow(2.4)[rows]
    noon = hue("noon", rows)
    assert float((noon - captured / captured.mean(1, keepdim=True)).abs().mean()) < 0.1


def gain_of(scene: SplatScene, terms: dict[str, list[float]], level: NDArray[np.float64],
            opened: NDArray[np.float64], met: NDArray[np.float64]) -> torch.Tensor:  # fmt: skip
    """Gains of things by the formula of `web/sun.js`."""
    head = surfaces_header(scene.light_found)
    u, o, m = (torch.from_numpy(each)[:, None] for each in (level, opened, met))
    sun, sky, bounce = (torch.tensor(terms[name]) for name in ("sun", "sky", "bounce"))
    ratio = (m * sun / o + u * sky + (1 - u) * bounce) / (u + (1 - u) * head["albedo"])
    y = srgb_to_linear(scene.gaussians.colours.clamp(0, 1))
    lit = ratio * y / (1 - head["shoulder"] * y)
    return ((encoded(lit / (1 + head["shoulder"] * lit)) + 0.055) / (encoded(y) + 0.055)).clamp_max(
        head["most"]
    )


@pytest.mark.parametrize("config", [NOON, SunConfig(light="overcast"), SunConfig(light="golden-hour")])
def test_gains_by_bytes_are_as_far_from_exact_ones_as_half_a_step_of_each_takes_them(
    scene: SplatScene, config: SunConfig
) -> None:
    known = scene.light_found
    level, opened = packed_surfaces(known) / 255
    light = packed_light(known, config)
    met = np.zeros(len(level)) if light.met is None else light.met / 255
    # The gain is monotone in each byte: what half a step up or down makes of it bounds the exact one.
    corners = []
    for signs in itertools.product((-1, 1), repeat=3):
        shares = []
        for share, sign in zip((level, opened, met), signs, strict=True):
            shares.append(np.clip(share + sign * HALF_STEP, 0, 1))
        corners.append(gain_of(scene, light.head, *shares))
    exact = known.gain(config)
    thing = ~known.sky
    low = torch.stack(corners).amin(0)[thing]
    high = torch.stack(corners).amax(0)[thing]
    assert ((exact[thing] >= low - 1e-4) & (exact[thing] <= high + 1e-4)).all()
    assert float((high - low).mean()) < 0.03


def test_a_day_goes_from_one_blue_hour_to_the_other_by_way_of_noon() -> None:
    hours = day(9, noon=30.0)
    times = [each.hour for each in hours]
    assert times == sorted(times) and len(hours) == 11
    assert hours[0].config == hours[-1].config == SunConfig(light="blue-hour")
    assert hours[5].hour == 12 and (hours[5].azimuth, hours[5].elevation) == pytest.approx((30, 55))
    assert all(each.config.sun == (each.azimuth, each.elevation) for each in hours[1:-1])
    heights = [each.elevation for each in hours]
    assert heights[:6] == sorted(heights[:6]) and heights == pytest.approx(heights[::-1])
    around = [(each.azimuth - 30 + 180) % 360 - 180 for each in hours]
    assert around == sorted(around), "clockwise"
    # South of the equator it rises in the east, too, and stands in the north at noon.
    south = day(9, noon=0.0, clockwise=False)
    assert south[1].azimuth > 0 > south[-2].azimuth and south[5].azimuth == pytest.approx(0)
    north = day(9, noon=180.0)
    assert 0 < north[1].azimuth < 180 and -180 < north[-2].azimuth < 0


@pytest.mark.parametrize("count", [-1, 1, 65])
def test_a_day_has_no_such_number_of_suns(count: int) -> None:
    with pytest.raises(ConfigError, match="suns"):
        check_suns(count)


def test_a_page_holds_a_byte_a_sun_of_the_gaussians_that_it_shows(tmp_path: Path) -> None:
    scene = seen(ball(3000))
    suns = packed_day(scene.light_found, 8)
    some = torch.tensor([5, 3, 2999])
    held = np.frombuffer(zlib.decompress(suns.section(some)), np.uint8).reshape(10, 3)
    assert (held[:2] == suns.surfaces[:, some.numpy()]).all()
    assert suns.day[1].met is not None and (held[2] == suns.day[1].met[some.numpy()]).all()
    assert [light.met is None for light in suns.day] == [True, *[False] * 8, True]
    page = page_of(scene)
    plain, count = page_html(page)
    lit, _ = page_html(page_of(scene, suns=8))
    assert 'id="data-light"' in lit and 'id="data-light"' not in plain
    assert len(lit) - len(plain) < 10 * count * 4 / 3 + 6000
    # A budget counts them.
    megabytes = len(plain) / 2**20
    small, fewer = page_html(page_of(scene, suns=8), megabytes=megabytes)
    assert fewer < count and len(small.encode()) <= megabytes * 2**20
