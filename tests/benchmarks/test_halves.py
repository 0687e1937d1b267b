"""The half-image protocol: what is cut, which lights are chosen, and oracles that know the truth; points of pairs."""

from pathlib import Path

import pytest
import torch

from benchmarks.correspondences import at_points, read_pair, scores
from benchmarks.correspondences import main as correspondences
from benchmarks.halves import AFFINE, REGION_AFFINE, best_affine, halves, judge_pair
from benchmarks.light import chosen_lights, main
from benchmarks.wild import main as wild
from fprf.errors import DataError
from fprf.io.images import to_uint8, write_image


def test_halves_leave_out_the_middle_of_an_odd_width() -> None:
    image = torch.arange(7.0).expand(2, 7)[..., None]
    left, right = halves(image)
    assert left[0, :, 0].tolist() == [0, 1, 2] and right[0, :, 0].tolist() == [4, 5, 6]


def test_oracles_undo_what_is_affine_and_never_lose() -> None:
    """One affine map in each of two regions: the map of each region is exact, one for both is not."""
    draw = torch.Generator().manual_seed(0)
    plain = torch.rand(32, 70, 3, generator=draw)
    regions = torch.zeros(32, 70, 2)
    regions[:16, :, 0] = 1
    regions[16:, :, 1] = 1
    light = torch.where(regions[..., :1] > 0, 0.5 * plain + 0.1, 0.6 * plain.flip(-1))
    rows, pictures = judge_pair(plain, light, {}, regions)
    assert rows[REGION_AFFINE]["psnr"] > 50 > 30 > rows[AFFINE]["psnr"] > rows["no change"]["psnr"]
    assert torch.equal(pictures["light"], light)
    same = best_affine(plain.flatten(0, 1), plain.flatten(0, 1), regions.flatten(0, 1))
    assert float((same - plain.flatten(0, 1)).abs().max()) < 2e-3  # the ridge: 1e-4 beside a variance of 1/12


def test_lights_are_the_usual_one_and_the_farthest_from_all_before() -> None:
    values = torch.tensor([[0.0], [0.1], [0.2], [1.0], [-0.5]])
    assert chosen_lights(values, 2) == (1, [3, 4])
    assert sorted(chosen_lights(values, 9)[1]) == [0, 2, 3, 4], "no more than there are"


def test_what_is_absent_is_skipped_with_a_reason(capsys) -> None:
    assert main(["--folder", "nowhere"]) == 0 and wild([]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[0].startswith("light: skipped, nowhere is no folder") and told[1].startswith("wild: skipped")


def test_points_of_a_pair_are_read_at_its_reduced_size(tmp_path: Path, capsys) -> None:
    """A dot in one colour on either picture: that colour is found at the points, and the pair's error is 0."""
    for k, (width, x) in enumerate(((400, 100), (300, 200))):
        image = torch.full((120, width, 3), 0.5)
        image[35:66, x - 15 : x + 16] = torch.tensor([0.8, 0.2, 0.2])
        write_image(tmp_path / f"0{k + 1}.png", to_uint8(image))
    (tmp_path / "corrs.txt").write_text("100 50 200 50\n")
    first, second = read_pair(tmp_path, 200)
    assert first.image.shape == (60, 200, 3) and second.image.shape == (80, 200, 3)
    truth = at_points(second, second.image)
    assert torch.allclose(truth, torch.tensor([[0.8, 0.2, 0.2]]), atol=0.01)
    assert scores(first, first.image, truth)["psnr"] > 40 and scores(first, first.image, truth)["delta_e"] < 1
    assert scores(first, torch.zeros_like(first.image), truth)["psnr"] < 10
    (tmp_path / "corrs.txt").write_text("100 50 200\n")
    with pytest.raises(DataError, match=r"corrs\.txt.*x1 y1 x2 y2"):
        read_pair(tmp_path, 200)
    assert correspondences(["--folder", "nowhere"]) == 0
    assert capsys.readouterr().out.startswith("correspondences: skipped, no pairs in nowhere")
