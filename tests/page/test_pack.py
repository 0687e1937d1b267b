import numpy as np
import pytest
import torch
from pages import recoloured, street
from splat_ball import ball

from fprf.page.pack import CHUNK, fit_maps, pack
from fprf.splats.files.base import three_to_four
from fprf.splats.gaussians import HARMONIC, Gaussians


def unpacked(gaussians: Gaussians, entries: int = 4096) -> tuple[torch.Tensor, Gaussians]:
    """Order and what a browser reads: the inverse of the packing, written from its description."""
    packed = pack(gaussians, entries)
    words = packed.shape.view("<u4").astype(np.int64)
    chunk = packed.chunks[np.arange(len(words)) // CHUNK].astype(np.float64)
    place = np.stack([words[:, 0] & 65535, words[:, 0] >> 16, words[:, 1] & 65535], 1) / 65535
    size = np.stack([words[:, 3] >> shift & 255 for shift in (0, 8, 16)], 1) / 255
    turn = np.stack([words[:, 2] >> shift & 1023 for shift in (0, 10, 20)], 1) / 1023 * 2 - 1
    means = chunk[:, :3] + place * (chunk[:, 3:6] - chunk[:, :3])
    scales = chunk[:, 6:9] + size * (chunk[:, 9:] - chunk[:, 6:9])
    level = packed.palette[..., :3].astype(np.float64) / 127
    rest = (packed.largest * level * abs(level))[words[:, 1] >> 16] if level.size else np.zeros((len(words), 0, 3))
    colours = packed.colours(gaussians.harmonics)
    mean = colours.low + colours.rows[:, :3] / 255 * (colours.high - colours.low)
    harmonics = np.concatenate([((mean - 0.5) / HARMONIC)[:, None], rest], 1)
    opacity = torch.logit(torch.from_numpy(words[:, 3] >> 24) / 255, 1e-6)
    parts = [torch.from_numpy(each).float() for each in (means, three_to_four(words[:, 2] >> 30, turn), scales, harmonics)]
    return packed.order, Gaussians(parts[0], parts[1], parts[2], opacity.float(), parts[3])


@pytest.mark.parametrize("gaussians", [ball(700, 0), ball(3000, 2), street(), ball(300, 3), ball(1)], ids=len)
def test_what_is_packed_is_near_to_what_was_given(gaussians: Gaussians) -> None:
    order, read = unpacked(gaussians)
    given = gaussians.select(order)
    assert sorted(order.tolist()) == list(range(len(gaussians)))
    spread = given.means.norm(dim=1, keepdim=True) + 1
    assert float(((read.means - given.means) / spread).abs().max()) < 1e-3
    assert float((read.log_scales - given.log_scales).abs().max()) < 0.03
    assert float((read.opacities - given.opacities).abs().max()) < 0.003
    turned = (torch.nn.functional.normalize(given.quaternions, dim=1) * read.quaternions).sum(1).abs()
    assert float(turned.min()) > 0.9999
    assert float((read.colours - given.colours.clamp(-1, 2)).abs().max()) < 0.007
    kept = read.harmonics.shape[1]
    assert kept == min(9, given.harmonics.shape[1])
    if kept > 1:
        assert float((read.harmonics[:, 1:] - given.harmonics[:, 1:kept]).abs().max()) < 0.01


def test_a_palette_of_few_entries_keeps_most_of_the_harmonics() -> None:
    gaussians = ball(3000, 2)
    order, read = unpacked(gaussians, 256)
    given = gaussians.select(order).harmonics[:, 1:]
    assert float((read.harmonics[:, 1:] - given).square().mean()) < 0.8 * float(given.square().mean())


def test_the_maps_of_a_style_carry_its_view_dependence() -> None:
    gaussians = ball(2000, 2)
    styled = recoloured(gaussians)
    label, maps = fit_maps(gaussians.harmonics[:, 1:], styled[:, 1:])
    made = torch.einsum("nkc,ncd->nkd", gaussians.harmonics[:, 1:], torch.from_numpy(maps).view(-1, 3, 3)[label.astype(int)])
    assert float((made - styled[:, 1:]).abs().max()) < 1e-4
    assert len(maps) <= 256
