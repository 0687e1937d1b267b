import torch
from torch import Tensor

from fprf.evaluation.metrics import psnr
from fprf.evaluation.town_truth import best_class_maps, true_class_maps


def picture(seed: int) -> Tensor:
    return 0.2 + 0.6 * torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(seed))


grid = torch.arange(256).reshape(16, 16) % 3


def test_the_best_maps_find_any_map_of_classes() -> None:
    plain = picture(1)
    truth = plain.clone()
    for kind, matrix in enumerate((torch.eye(3).flip(0), 0.5 * torch.eye(3), torch.zeros(3, 3))):
        truth[grid == kind] = plain[grid == kind] @ matrix + 0.1 * (kind == 1) + 0.3 * (kind == 2)
    (found,) = best_class_maps([(plain, grid)], [truth])
    assert psnr(found, truth) > 45


def test_nothing_beats_the_best_maps_among_maps_of_classes() -> None:
    plain, truth = picture(2), picture(3)
    references = [(picture(4), grid)]
    best = best_class_maps([(plain, grid)], [truth])[0]
    known = true_class_maps([(plain, grid)], references)[0]
    assert psnr(best, truth) >= psnr(known, truth)
    assert psnr(best, truth) >= psnr(plain, truth)


def test_true_classes_get_the_references_colours() -> None:
    plain, style = picture(5), 0.3 + 0.4 * picture(6)
    style[grid == 2] = style[grid == 2] * 0.5
    (found,) = true_class_maps([(plain, grid)], [(style, grid)])
    for kind in range(3):
        here, there = found[grid == kind], style[grid == kind]
        assert torch.allclose(here.mean(0), there.mean(0), atol=0.01)
        assert torch.allclose(here.std(0), there.std(0), atol=0.02)
    other = torch.full_like(grid, 7)
    (found,) = true_class_maps([(plain, grid)], [(style, other)])
    for kind in range(3):
        assert torch.allclose(found[grid == kind].mean(0), style.reshape(-1, 3).mean(0), atol=0.01)
