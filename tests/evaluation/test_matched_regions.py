import torch
from torch import Tensor

from fprf.evaluation.style_distance import matched_regions
from fprf.interfaces import Encoder


class Halved(Encoder):
    """Colours at half the size."""

    @property
    def identity(self) -> str:
        return "halved"

    @property
    def channels(self) -> int:
        return 3

    def forward(self, image: Tensor) -> Tensor:
        return torch.nn.functional.avg_pool2d(image, 2)


def bands(heights: tuple[int, ...], colours: list[tuple[float, float, float]]) -> Tensor:
    return torch.cat([torch.tensor(c).expand(h, 12, 3) for h, c in zip(heights, colours, strict=True)])


DAY = [(0.2, 0.4, 0.9), (0.9, 0.2, 0.2), (0.2, 0.8, 0.2)]
NIGHT = [(0.1, 0.15, 0.3), (0.3, 0.1, 0.08), (0.1, 0.28, 0.08)]


def test_bands_of_another_light_find_their_like() -> None:
    content, other, style = bands((8, 4, 12), DAY), bands((4, 12, 8), DAY), bands((8, 8, 8), NIGHT)
    here, there = matched_regions(Halved(), [content, other], [style], regions=3, seed=0)
    assert [tuple(each.shape) for each in here] == [(12, 6), (12, 6)]
    sky, wall, grass = (int(there[0][row, 0]) for row in (1, 5, 9))
    assert len({sky, wall, grass}) == 3
    assert there[0].equal(torch.tensor([sky, wall, grass]).repeat_interleave(4)[:, None].expand(12, 6))
    assert here[0][:, 0].tolist() == [sky] * 4 + [wall] * 2 + [grass] * 6
    assert here[1][:, 0].tolist() == [sky] * 2 + [wall] * 6 + [grass] * 4


def test_a_style_of_one_colour_has_one_region() -> None:
    grey = torch.full((8, 8, 3), 0.5)
    here, there = matched_regions(Halved(), [bands((4, 4, 4), DAY)], [grey, grey], regions=5, seed=0)
    assert len(there) == 2
    assert {int(n) for each in (*here, *there) for n in each.unique()} == {0}
