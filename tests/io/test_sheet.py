import numpy as np
import pytest
import torch

from fprf.io.maps import match_image, palette, scale_image
from fprf.io.sheet import Tile, highlight, sheet


def picture(height: int = 20, width: int = 30) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_what_is_highlighted_keeps_its_colours_and_the_rest_loses_them() -> None:
    image = picture()
    inside = torch.zeros(20, 30)
    inside[:, 15:] = 1
    shown = highlight(image, inside)
    assert np.array_equal(shown[5:15, 20:28], image[5:15, 20:28])
    assert np.ptp(shown[:, :12].astype(int), axis=2).max() <= 1, "grey"
    assert np.array_equal(highlight(image, torch.ones(20, 30))[1:-1, 1:-1], image[1:-1, 1:-1])


def test_a_small_map_highlights_a_large_picture() -> None:
    assert highlight(picture(64, 96), torch.rand(4, 6)).shape == (64, 96, 3)


@pytest.mark.parametrize("count", [0, 1, 4, 5, 9])
def test_tiles_are_laid_out_in_rows(count: int) -> None:
    page = sheet([Tile(picture(), ("0: 12 % of the scene", "größer.jpg 80 %"), (0.6, 0.2))] * count)
    assert page.dtype == np.uint8 and page.shape[2] == 3
    if count:
        one = sheet([Tile(picture(), ("0: 12 % of the scene", "größer.jpg 80 %"), (0.6, 0.2))])
        rows, columns = -(-count // 4), min(4, count)
        assert page.shape[0] == 8 + rows * (one.shape[0] - 8) and page.shape[1] == 8 + columns * (one.shape[1] - 8)


def test_pictures_of_several_shapes_fit_one_sheet() -> None:
    page = sheet([Tile(picture(60, 20), ("tall",)), Tile(picture(20, 900), ("wide",)), Tile(picture(1, 1), ())])
    assert page.shape[0] > 3 * 200


def test_shares_are_drawn_in_the_references_colours() -> None:
    page = sheet([Tile(np.zeros((100, 240, 3), np.uint8), (), (0.25, 0.5))])
    bar = page[8 + 100 + 2, 8 : 8 + 240].astype(int)
    first, second = (palette(2) * 255).round().int().tolist()
    assert bar[10].tolist() == first and bar[100].tolist() == second and bar[220].min() > 200


def test_long_lines_stay_inside() -> None:
    assert np.array_equal(sheet([Tile(picture(), ("x" * 400,))])[:, -8:], sheet([Tile(picture(), ("y",))])[:, -8:])


def test_scales_are_fixed_and_ends_are_held() -> None:
    values = torch.tensor([[-5.0, 0.0, 0.5, 1.0, 7.0]])
    shown = scale_image(values, 0.0, 1.0).astype(int)
    assert np.array_equal(shown[0, 0], shown[0, 1]) and np.array_equal(shown[0, 3], shown[0, 4])
    assert shown[0, 0].sum() < shown[0, 2].sum() < shown[0, 3].sum()
    empty = scale_image(values, 0.0, 1.0, torch.zeros(1, 5))
    assert np.ptp(empty[0], axis=0).max() == 0
    assert scale_image(torch.full((2, 2), float("nan")), 0.0, 1.0).shape == (2, 2, 3)


def test_what_is_kept_is_pale_in_a_match_map() -> None:
    attention = torch.tensor([[[1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]])
    kept = torch.tensor([[0.0, 0.5, 1.0]])
    shown = match_image(attention, torch.tensor([0, 1]), ["a", "b"], None, kept).astype(int)
    plain = match_image(attention, torch.tensor([0, 1]), ["a", "b"])
    assert np.array_equal(shown[0, 0], plain[0, 0]) and shown[0, 2].min() > 200
    assert shown[0, 0].sum() < shown[0, 1].sum() < shown[0, 2].sum()
