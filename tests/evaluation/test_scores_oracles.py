"""Figures against their definitions written out, and bounds that must hold for any pictures."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fprf.evaluation.metrics import delta_e, psnr
from fprf.evaluation.town_truth import (
    KINDS,
    Reference,
    Row,
    best_class_maps,
    interior,
    match_rates,
    mean_rows,
    score,
    true_class_maps,
    winners,
)
from fprf.town.surface import CLASSES


def picture(seed: int, low: float = 0.2, high: float = 0.8) -> Tensor:
    return low + (high - low) * torch.rand(12, 14, 3, generator=torch.Generator().manual_seed(seed))


def grid(seed: int, kinds: int) -> Tensor:
    return torch.randint(0, kinds, (12, 14), generator=torch.Generator().manual_seed(seed))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 99), st.integers(1, 5), st.integers(1, 3))
def test_scores_are_their_definition(seed: int, kinds: int, views: int) -> None:
    found, truth = ([picture(base + seed + k) for k in range(views)] for base in (0, 100))
    labels = [grid(seed + k, kinds) for k in range(views)]
    row, by_class = score(found, truth, labels)
    assert row["psnr"] == pytest.approx(sum(psnr(a, b) for a, b in zip(found, truth, strict=True)) / views)
    apart = [delta_e(a, b) for a, b in zip(found, truth, strict=True)]
    assert row["delta_e"] == pytest.approx(float(torch.stack(apart).mean()), rel=1e-5)
    for kind in set(torch.cat(labels).flatten().tolist()):
        inside = torch.cat([d[m == kind] for d, m in zip(apart, labels, strict=True)])
        assert by_class[CLASSES[kind]] == pytest.approx(float(inside.mean()), rel=1e-5)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 99), st.integers(1, 4))
def test_maps_that_know_the_truth_are_never_worse_than_doing_nothing(seed: int, kinds: int) -> None:
    plain, truth, labels = picture(seed), picture(seed + 100), grid(seed, kinds)
    (found,) = best_class_maps([(plain, labels)], [truth])
    assert psnr(found, truth) >= psnr(plain, truth) - 1e-3
    assert float(found.min()) >= 0 and float(found.max()) <= 1


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 99), st.integers(1, 4))
def test_more_classes_never_make_the_bound_worse(seed: int, kinds: int) -> None:
    plain, truth, coarse = picture(seed), picture(seed + 100), grid(seed, kinds)
    fine = coarse * 2 + grid(seed + 7, 2)
    one, two = (best_class_maps([(plain, labels)], [truth])[0].double() for labels in (coarse, fine))
    errors = [float((x - truth).square().mean()) for x in (one, two)]
    assert errors[1] <= errors[0] + 1e-4, "the ridge costs a little"


def test_true_classes_of_the_scene_itself_change_nothing() -> None:
    plain, labels = picture(1, 0.3, 0.7), grid(1, 3)
    (found,) = true_class_maps([(plain, labels)], [(plain, labels)])
    torch.testing.assert_close(found, plain, rtol=0.0, atol=1e-5)


def test_true_classes_do_not_depend_on_the_order_of_references() -> None:
    plain, labels = picture(2), grid(2, 3)
    references = [(picture(3), grid(3, 3)), (picture(4), grid(4, 2))]
    forth, back = (true_class_maps([(plain, labels)], order)[0] for order in (references, references[::-1]))
    torch.testing.assert_close(forth, back)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 999), st.integers(1, len(CLASSES)))
def test_rates_are_their_definition(seed: int, kinds: int) -> None:
    truth, found = grid(seed, kinds), grid(seed + 1, kinds)
    found = torch.where(grid(seed + 2, 2) == 0, truth, found)
    reference = Reference("all", picture(0), torch.arange(len(CLASSES))[None])
    rates = match_rates([found], [truth], [reference])
    right, inside = found == truth, interior(truth)
    assert rates.match == pytest.approx(float(right.double().mean()))
    kind = torch.tensor([KINDS[k] for k in range(len(CLASSES))])
    assert rates.match_kind == pytest.approx(float((kind[found] == kind[truth]).double().mean()))
    assert rates.match_kind is not None and rates.match is not None and rates.match_kind >= rates.match
    for rate, where in ((rates.match_inside, inside), (rates.match_border, ~inside)):
        assert (rate is None) == (not bool(where.any()))
        assert rate is None or rate == pytest.approx(float(right[where].double().mean()))


@given(st.integers(1, 40), st.integers(1, 9), st.integers(0, 99))
def test_winners_hold_the_largest_share(pixels: int, codes: int, seed: int) -> None:
    share = torch.rand(pixels, codes, generator=torch.Generator().manual_seed(seed))
    classes = torch.arange(codes) + 3
    taken = winners(share, classes) - 3
    assert torch.equal(share.gather(1, taken[:, None])[:, 0], share.amax(1))


@given(st.lists(st.one_of(st.none(), st.floats(-1e3, 1e3)), min_size=1, max_size=6))
def test_means_are_over_what_is_known(values: list[float | None]) -> None:
    tables: list[dict[str, Row]] = [{"a": {"x": value}} for value in values]
    known = [value for value in values if value is not None]
    found = mean_rows(tables)["a"]["x"]
    assert (found is None) == (not known)
    assert found is None or found == pytest.approx(math.fsum(known) / len(known))
