"""The half-image protocol: what is cut, which lights are chosen, and oracles that know the truth."""

import torch

from benchmarks.halves import AFFINE, REGION_AFFINE, best_affine, halves, judge_pair
from benchmarks.light import chosen_lights, main
from benchmarks.wild import main as wild


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
