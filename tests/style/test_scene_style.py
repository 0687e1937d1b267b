import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from style_cases import points

from fprf.errors import CheckpointError
from fprf.style.scene_style import Membership, from_tensors, region_smoothing, scene_style, to_tensors


def weighted() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return *points(1200), torch.rand(1200)


def test_regions_are_the_clusters_and_their_statistics_those_of_the_soft_membership() -> None:
    content, semantic, weights = weighted()
    scene = scene_style(content, semantic, weights, None, 3, 0)
    assert scene.keys.shape == (3, 4)
    share = Membership(scene.keys, scene.semantic_mean)(semantic).double()
    for k in range(3):
        w = share[:, k] * weights
        mean = (w[:, None] * content).sum(0) / w.sum()
        apart = content - mean
        torch.testing.assert_close(scene.region_mean[k].double(), mean, rtol=1e-4, atol=1e-5)
        own = (w[:, None, None] * apart[:, :, None] * apart[:, None, :]).sum(0) / w.sum()
        torch.testing.assert_close(scene.region_covariance[k].double(), own, rtol=1e-4, atol=1e-4)
        assert float(scene.share[k]) == pytest.approx(float(w.sum() / weights.double().sum()), rel=1e-5)
    assert len(share.argmax(1).unique()) == 3


def test_without_semantics_there_is_one_region() -> None:
    content, _, weights = weighted()
    scene = scene_style(content, None, weights, None, 8, 0)
    assert scene.keys.shape == (1, 0) and scene.semantic_mean.shape == (0,)
    torch.testing.assert_close(scene.region_mean[0], scene.mean)
    torch.testing.assert_close(scene.region_covariance[0], scene.covariance)
    assert scene.share.tolist() == [1.0]


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 30), st.integers(1, 40), st.integers(1, 3), st.sampled_from([0.0, 1e-3, 1.0, 1e4]))
def test_any_scene_has_a_finite_style(n: int, regions: int, d: int, spread: float) -> None:
    content, semantic = torch.randn(n, 3) * spread, torch.randn(n, d) * spread + 5
    scene = scene_style(content, semantic, torch.rand(n) + 0.01, None, regions, 0)
    assert all(bool(t.isfinite().all()) for t in scene)
    assert 1 <= len(scene.keys) <= min(n, regions)
    assert bool((scene.share > 0).all())
    share = Membership(scene.keys, scene.semantic_mean)(semantic)
    torch.testing.assert_close(share.sum(1), torch.ones(n), rtol=0.0, atol=1e-6)


def test_tensors_round_trip_and_runs_without_contacts_are_read() -> None:
    tensors = to_tensors(scene_style(*weighted(), None, 3, 0))
    assert all(torch.equal(value, tensors[name]) for name, value in from_tensors(tensors)._asdict().items())
    del tensors["contacts"]
    assert torch.equal(from_tensors(tensors).contacts, torch.zeros(3, 3))


@pytest.mark.parametrize(
    ("name", "value"), [("share", None), ("region_mean", torch.zeros(3, 9)), ("keys", torch.full((3, 4), float("inf")))]
)
def test_damaged_tensors_are_named(name: str, value: torch.Tensor | None) -> None:
    tensors = to_tensors(scene_style(*weighted(), None, 3, 0))
    del tensors[name]
    with pytest.raises(CheckpointError, match=name):
        from_tensors(tensors if value is None else tensors | {name: value})


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.floats(0, 1e4), st.integers(0, 99))
def test_smoothing_mixes_and_keeps_the_mean_over_the_scene(regions: int, smoothness: float, seed: int) -> None:
    draw = torch.Generator().manual_seed(seed)
    scene = scene_style(*weighted(), None, 8, 0)
    contacts = torch.rand(regions, regions, generator=draw)
    share = torch.rand(regions, generator=draw) + 0.01
    scene = scene._replace(contacts=contacts + contacts.T, share=share / share.sum())
    smooth = region_smoothing(scene, smoothness)
    assert bool((smooth >= -1e-12).all())
    torch.testing.assert_close(smooth.sum(1), torch.ones(regions, dtype=torch.float64))
    torch.testing.assert_close(scene.share.double() @ smooth, scene.share.double())
    far = region_smoothing(scene, 1e9)
    torch.testing.assert_close(far, scene.share.double().expand(regions, -1), rtol=0.0, atol=1e-5)
