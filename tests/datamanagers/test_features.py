"""The feature store and the semantic basis: right values, made once; a file is right or absent."""

import errno
import os
import time
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from fprf.datamanagers import features as store_files
from fprf.datamanagers.basis import Basis, fit_basis
from fprf.datamanagers.features import FeatureStore, Projection, extract
from fprf.errors import DataError, NumericsError, PluginError
from fprf.interfaces import Encoder
from fprf.io import tensorfiles
from fprf.ops import guided
from fprf.ops.config import GuidedConfig


def test_what_was_used_longest_ago_goes_first_and_what_is_in_use_stays(tmp_path: Path) -> None:
    keys = [store_files.digest(str(k)) for k in range(5)]
    for age, key in enumerate(keys):
        tensorfiles.save(tmp_path / f"{key}.safetensors", {"x": torch.zeros(1000)}, sealed=True)
        os.utime(tmp_path / f"{key}.safetensors", (1e9 - age, 1e9 - age))
    size = (tmp_path / f"{keys[0]}.safetensors").stat().st_size
    assert store_files.read_kept(tmp_path, keys[4]) is not None, "which makes it the youngest"
    store_files.keep_within(tmp_path, 3 * size, {keys[3]})
    assert {path.stem for path in tmp_path.iterdir()} == {keys[0], keys[3], keys[4]}
    store_files.keep_within(tmp_path, 0, {keys[3], keys[4]})
    assert {path.stem for path in tmp_path.iterdir()} == {keys[3], keys[4]}


SIZES = {0: (30, 44), 3: (30, 44), 4: (25, 37), 9: (50, 20)}


class Counting(Encoder):
    """Box means, mixed to some channels; counts how often it is asked."""

    def __init__(self, channels: int = 5, gain: float = 1.0, name: str = "") -> None:
        super().__init__()
        self.register_buffer(
            "mix", gain * torch.randn(channels, 3, generator=torch.Generator().manual_seed(0))
        )
        self.name = name or f"counting {channels} {gain}"
        self.calls = 0
        self.fail_after = 1 << 30

    @property
    def identity(self) -> str:
        return self.name

    @property
    def channels(self) -> int:
        return len(self.get_buffer("mix"))

    def forward(self, image: Tensor) -> Tensor:
        self.calls += 1
        if self.calls > self.fail_after:
            raise KeyboardInterrupt
        small = F.adaptive_avg_pool2d(image, (image.shape[2] // 4, image.shape[3] // 4))
        return torch.einsum("ci,bihw->bchw", self.get_buffer("mix"), small.square())


def picture(view: int) -> Tensor:
    height, width = SIZES[view]
    coarse = torch.rand(1, 3, 5, 6, generator=torch.Generator().manual_seed(view))
    smooth = F.interpolate(coarse, (height, width), mode="bilinear") + F.interpolate(
        coarse.flip(2), (height, width)
    )
    return (smooth[0].permute(1, 2, 0) * 127).byte().contiguous()


def draw(count: int = 300) -> tuple[Tensor, Tensor, Tensor]:
    """Random pixels of the views with their colours."""
    view = torch.tensor(list(SIZES))[torch.randint(len(SIZES), (count,))]
    size = torch.tensor([SIZES[v] for v in view.tolist()])
    y, x = (torch.rand(count, 2) * size).long().unbind(1)
    rgb = (
        torch.stack(
            [picture(v)[at] for v, at in zip(view.tolist(), zip(y, x, strict=True), strict=True)]
        ).float()
        / 255
    )
    return view, torch.stack([x, y], 1) + 0.5, rgb


def build(
    folder: Path, encoder: Encoder, config: GuidedConfig | None = None, dim: int | None = None
) -> FeatureStore:
    projection = None if dim is None else Projection(dim)
    guided = config or GuidedConfig(radius=0.2)
    return extract(folder, list(SIZES), picture, encoder, guided, projection=projection)


def truth(encoder: Encoder, view: Tensor, pixel: Tensor, rgb: Tensor) -> Tensor:
    """What the filter says, in float32, one ray at a time."""
    found = torch.empty(len(view), encoder.channels)
    for v in view.unique().tolist():
        rows = view == v
        guide = picture(v).float() / 255
        radius = round(0.2 * min(SIZES[v]))
        stride = min(8, (2 * radius + 1) // 5)
        maps = encoder(guide.permute(2, 0, 1)[None])[0]
        coefs = guided.coefficients(maps, guide, radius=radius, eps=1e-3, stride=stride)
        found[rows] = guided.apply(coefs, pixel[rows], rgb[rows], SIZES[v])
    return found


@pytest.mark.parametrize("channels", [1, 5, 8, 21])
def test_the_store_answers_what_the_filter_says(tmp_path: Path, channels: int) -> None:
    encoder = Counting(channels)
    store = build(tmp_path, encoder)
    where = draw()
    expected = truth(encoder, *where)
    assert store.channels == channels and store.basis is None
    found = store.at(*where)
    assert found.dtype == torch.float32
    assert (found - expected).abs().max() <= 4e-3 * expected.std()
    assert store.at(*(part[:0] for part in where)).shape == (0, channels)
    with pytest.raises(DataError, match="no views"):
        FeatureStore({})
    for view in (7, 10, -1):
        with pytest.raises(DataError, match=f"view {view} has no features"):
            store.at(torch.tensor([0, view]), torch.zeros(2, 2), torch.zeros(2, 3))


@pytest.mark.parametrize("channels", [5, 8])
def test_without_a_folder_to_write_to_the_answers_are_the_same(tmp_path: Path, channels: int) -> None:
    (tmp_path / "file").touch()
    where = draw()
    encoder = Counting(channels)
    with_files = build(tmp_path / "folder", encoder, dim=4)
    without = build(tmp_path / "file/folder", encoder, dim=4)
    assert torch.equal(without.at(*where), with_files.at(*where)) and without.scale == with_files.scale
    raw = build(tmp_path / "file/folder", encoder)
    assert torch.equal(raw.at(*where), build(tmp_path / "folder", encoder).at(*where))


@pytest.mark.parametrize("channels", [5, 8])
def test_features_that_no_disk_has_room_for_stay_in_memory(
    tmp_path: Path, channels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = draw()
    encoder = Counting(channels)
    expected = build(tmp_path / "a", encoder).at(*where)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(tensorfiles.safetensors.torch, "save_file", full)
    assert torch.equal(build(tmp_path / "b", encoder).at(*where), expected)
    assert not list((tmp_path / "b").iterdir())


def test_the_spread_is_that_of_the_targets(tmp_path: Path) -> None:
    encoder = Counting(6)
    store = build(tmp_path, encoder)
    values = []
    for view, (height, width) in SIZES.items():
        y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        pixel = torch.stack([x, y], -1).flatten(0, 1) + 0.5
        values.append(
            store.at(torch.full((height * width,), view), pixel, picture(view).flatten(0, 1).float() / 255)
        )
    every = torch.cat(values)
    # 4 x 2048 drawn pixels: a variance to sqrt(2 / 8192); three of those.
    assert store.std == pytest.approx(float(every.var(0).mean().sqrt()), rel=0.03)
    assert store.scale == store.std


def test_semantics_are_the_projected_features(tmp_path: Path) -> None:
    """The filter is linear, so projecting before it or after is the same."""
    encoder = Counting(12)
    where = draw()
    raw = build(tmp_path / "raw", encoder)
    store = build(tmp_path / "semantic", encoder, dim=3)
    assert store.basis is not None and store.channels == 3 and store.basis.energy > 0.99
    expected = store.basis.project(raw.at(*where))
    assert (store.at(*where) - expected).abs().max() <= 8e-3 * expected.std()
    wide = build(tmp_path / "semantic", encoder, dim=50)
    assert wide.channels == 12


def test_whatever_changes_the_features_changes_the_files(tmp_path: Path) -> None:
    build(tmp_path, Counting(name="one"))
    for other, config, dim, changed in (
        (Counting(name="two"), GuidedConfig(radius=0.2), None, 4),
        (Counting(name="one"), GuidedConfig(radius=0.3), None, 4),
        (Counting(name="one"), GuidedConfig(radius=0.2, eps=1e-4), None, 4),
        (
            Counting(name="one"),
            GuidedConfig(radius=0.2, stride=1),
            None,
            3,
        ),  # view 9 is so narrow that it was 1 before
        (Counting(name="one"), GuidedConfig(radius=0.2), 2, 4),
    ):
        build(tmp_path, other, config, dim)
        assert other.calls == changed


def test_damaged_files_are_made_again(tmp_path: Path) -> None:
    encoder = Counting()
    where = draw(50)
    expected = build(tmp_path, encoder).at(*where)
    one, two, *_ = sorted(tmp_path.glob("*.safetensors"))
    one.write_bytes(one.read_bytes()[:-7])
    two.write_bytes(two.read_bytes()[:-7] + b"changed")
    assert torch.equal(build(tmp_path, encoder).at(*where), expected)
    assert encoder.calls == len(SIZES) + 2


@pytest.mark.parametrize(("size", "offset"), [(1e-6, 0.0), (1.0, -1e3), (1e8, 0.0)])
def test_half_precision_keeps_eleven_bits_whatever_the_magnitudes(
    tmp_path: Path, size: float, offset: float
) -> None:
    """No overflow, and no offset that eats the signal."""

    class Off(Counting):
        def forward(self, image: Tensor) -> Tensor:
            return size * (super().forward(image) + offset)

    encoder = Off(name=f"off {size} {offset}")
    where = draw()
    expected = truth(encoder, *where)
    assert (build(tmp_path, encoder).at(*where) - expected).abs().max() <= 4e-3 * expected.std() + 2e-6 * abs(
        offset
    ) * size


def test_an_interrupted_extraction_goes_on(tmp_path: Path) -> None:
    """An hour later what its process left unfinished goes as well."""
    for name, age in ((".a.0000.safetensors", 7200), (".b.0000.safetensors", 0)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (time.time() - age,) * 2)
    encoder = Counting()
    encoder.fail_after = 2
    with pytest.raises(KeyboardInterrupt):
        build(tmp_path, encoder)
    assert len(list(tmp_path.glob("[!.]*"))) == 2 and [path.name for path in tmp_path.glob(".*")] == [
        ".b.0000.safetensors"
    ]
    encoder.calls = 0
    encoder.fail_after = 99
    build(tmp_path, encoder)
    assert encoder.calls == len(SIZES) - 2 and len(list(tmp_path.glob("[!.]*"))) == len(SIZES)


def test_encoders_that_break_their_promise_are_named(tmp_path: Path) -> None:
    with pytest.raises(NumericsError, match=r"counting 2 nan: .* view 0 are not finite"):
        build(tmp_path, Counting(2, gain=float("nan")))

    class Liar(Counting):
        @property
        def channels(self) -> int:
            return 3

    with pytest.raises(PluginError, match="promises"):
        build(tmp_path, Liar(2))
    assert not list(tmp_path.glob("*"))


UNIT = 2.0**-24


@given(
    samples=st.integers(1, 40), channels=st.integers(1, 12), dim=st.integers(1, 15), seed=st.integers(0, 99)
)
def test_columns_are_orthonormal_and_energy_is_a_share(
    samples: int, channels: int, dim: int, seed: int
) -> None:
    x = torch.randn(samples, channels, generator=torch.Generator().manual_seed(seed))
    basis = fit_basis(x, dim)
    kept = min(dim, channels)
    assert basis.mean.shape == (channels,) and basis.matrix.shape == (channels, kept)
    assert (basis.matrix.T @ basis.matrix - torch.eye(kept)).abs().max() <= 8 * channels * UNIT
    assert 0 <= basis.energy <= 1 + 1e-12
    assert (basis.matrix.gather(0, basis.matrix.abs().argmax(0, keepdim=True)) > 0).all()


def test_against_the_singular_values() -> None:
    x = torch.randn(200, 10, dtype=torch.float64) * torch.logspace(1, -2, 10, dtype=torch.float64) + 5
    basis = fit_basis(x, 4)
    centred = x - x.mean(0)
    _, values, rows = torch.linalg.svd(centred, full_matrices=False)
    assert abs(basis.energy - float(values[:4].square().sum() / values.square().sum())) <= 1e-12
    assert ((rows[:4] @ basis.matrix.double()).diagonal().abs() - 1).abs().max() <= 1e-6
    variance = basis.project(x).var(0)
    assert (variance.diff() <= 0).all()


def test_a_plane_is_found_under_a_large_offset() -> None:
    """float32 samples at an offset of 1000 keep 6e-5 each; the plane they lie on must come out to that, not
    worse.
    """
    plane = torch.linalg.qr(torch.randn(20, 3, dtype=torch.float64))[0]
    flat = torch.randn(500, 3, dtype=torch.float64) @ plane.T
    basis = fit_basis((flat + 1000).float(), 3)
    assert 1 - basis.energy <= (1000 * UNIT) ** 2 * 20
    back = basis.project((flat + 1000).float()).double() @ basis.matrix.double().T
    assert (back - (flat - flat.mean(0))).abs().max() <= 1000 * UNIT * 16


def test_what_cannot_be_fitted_or_read_is_named() -> None:
    with pytest.raises(DataError, match="at least one"):
        fit_basis(torch.zeros(0, 3), 1)
    with pytest.raises(NumericsError, match="not finite"):
        fit_basis(torch.tensor([[1.0, float("nan")]]), 1)
    with pytest.raises(DataError, match="matrix missing"):
        Basis.from_tensors({"mean": torch.zeros(2), "energy": torch.tensor(1.0)})
    with pytest.raises(DataError, match="must be"):
        Basis.from_tensors({"mean": torch.zeros(2), "matrix": torch.zeros(3, 1), "energy": torch.tensor(1.0)})
