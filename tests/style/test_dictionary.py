"""Photographs to samples, and samples to style codes: statistics, files, and what cannot be used."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from photo_files import turned_jpeg
from PIL import Image

from fprf.datamanagers.basis import Basis
from fprf.errors import DataError
from fprf.ops.guided import upsample
from fprf.plugins.encoders.config import RandomConfig
from fprf.style.dictionary import (
    Encoders,
    Reference,
    StyleDictionary,
    build_dictionary,
    encode_photograph,
    whole_style,
)
from fprf.testing.cases import scene


def reference(
    name: str, n: int = 900, c: int = 5, d: int = 4, seed: int = 0, weight: float = 1.0
) -> Reference:
    """Three kinds of pixels, each with its own semantics and style."""
    g = torch.Generator().manual_seed(seed)
    kind = torch.arange(n) % 3
    semantic = torch.eye(3, d)[kind] * 10 + torch.randn(n, d, generator=g) * 0.1
    content = torch.randn(3, c, generator=g)[kind] * 3 + torch.randn(n, c, generator=g) * (kind[:, None] + 1)
    return Reference(name, content, semantic, weight)


def equal(a: StyleDictionary, b: StyleDictionary) -> bool:
    return (
        a.names == b.names
        and a.blend == b.blend
        and all(torch.equal(x, y) for x, y in zip(a[:6], b[:6], strict=True))
    )


@pytest.mark.parametrize("blend", [0.0, 0.3, 1.0])
def test_codes_are_the_blended_statistics_of_each_cluster_in_plain_float64(blend: float) -> None:
    r = reference("a")
    d = build_dictionary([r], clusters=3, blend=blend)
    kind = torch.arange(900) % 3
    content = r.content.double()
    whole_mean = content.mean(0)
    whole = torch.cov(content.T, correction=0)
    assert len(d.keys) == 3
    for t in range(3):
        inside = kind == int((d.keys[t]).argmax())
        torch.testing.assert_close(
            d.keys[t].double(), r.semantic[inside].double().mean(0), rtol=1e-5, atol=1e-6
        )
        mean = content[inside].mean(0)
        own = torch.cov(content[inside].T, correction=0)
        torch.testing.assert_close(
            d.mean[t].double(), (1 - blend) * mean + blend * whole_mean, rtol=1e-5, atol=1e-5
        )
        torch.testing.assert_close(
            d.covariance[t].double(), (1 - blend) * own + blend * whole, rtol=1e-5, atol=1e-5
        )
    torch.testing.assert_close(d.share, torch.full((3,), 1 / 3))


def test_the_order_of_the_references_plays_no_part() -> None:
    refs = [reference(f"r{i}", seed=i, weight=1 + i) for i in range(4)]
    expected = build_dictionary(refs)
    for order in ((3, 2, 1, 0), (1, 3, 0, 2)):
        assert equal(build_dictionary([refs[i] for i in order]), expected)
    for i, name in enumerate(expected.names):
        assert bool((expected.weight[expected.reference == i] == 1 + int(name[1])).all())


@pytest.mark.parametrize("blend", [0.0, 0.3, 0.9, 1.0])
def test_the_whole_style_is_that_of_all_pixels_whatever_the_blend(blend: float) -> None:
    refs = [reference("a", seed=1), reference("b", seed=2)]
    mean, total = whole_style(build_dictionary(refs, clusters=3, blend=blend))
    pixels = torch.cat([r.content for r in refs]).double()
    torch.testing.assert_close(mean, pixels.mean(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(total, torch.cov(pixels.T, correction=0), rtol=1e-4, atol=1e-4)


def test_unusable_references_are_named() -> None:
    with pytest.raises(DataError, match=r"x\.jpg: "):
        build_dictionary(
            [reference("a"), Reference("x.jpg", torch.full((4, 3), float("nan")), torch.zeros(4, 2))]
        )
    with pytest.raises(DataError):
        build_dictionary([])


@pytest.mark.parametrize("clusters", [1, 2, 7, 500])
@pytest.mark.parametrize("kind", ["one pixel", "one colour", "three colours", "huge norms", "zero"])
def test_degenerate_photographs_have_codes(kind: str, clusters: int) -> None:
    content, semantic = {
        "one pixel": (torch.tensor([[1.0, 2.0]]), torch.tensor([[3.0, 4.0, 5.0]])),
        "one colour": (torch.full((400, 2), 0.3), torch.full((400, 3), -2.0)),
        "three colours": (torch.eye(3, 2).repeat(50, 1), torch.eye(3).repeat(50, 1)),
        "huge norms": (torch.randn(300, 2) * 0.3 + 3000, torch.randn(300, 3) * 0.3 + 3000),
        "zero": (torch.zeros(100, 2), torch.zeros(100, 3)),
    }[kind]
    d = build_dictionary([Reference("x", content, semantic)], clusters=clusters)
    distinct = len(semantic.unique(dim=0))
    assert 1 <= len(d.keys) <= min(clusters, distinct) and all(bool(t.isfinite().all()) for t in d[:6])
    assert float(d.share.sum()) == pytest.approx(1.0)
    if distinct <= 3:
        assert len(d.keys) == min(clusters, distinct), "a code for each kind, where there may be so many"
        torch.testing.assert_close(d.share @ d.mean, content.mean(0), rtol=1e-5, atol=1e-5)


CONTENT = RandomConfig(channels=6, stride=2).build()
SEMANTIC = RandomConfig(channels=9, stride=8, seed=1).build()
BASIS = Basis(
    torch.randn(9, generator=torch.Generator().manual_seed(0)), torch.linalg.qr(torch.randn(9, 4))[0]
)
ENCODERS = Encoders(CONTENT, SEMANTIC, BASIS, scene(1, 6, 4))


def photo(folder: Path, height: int, width: int, *, flat: bool = False) -> Path:
    rng = np.random.default_rng(0)
    pixels = (
        np.full((height, width, 3), (40, 90, 200))
        if flat
        else rng.integers(0, 256, (height // 4 + 1, width // 4 + 1, 3))
    )
    smooth = cv2.resize(pixels.astype(np.uint8), (width, height), interpolation=cv2.INTER_LINEAR)
    path = folder / f"{height}x{width}.png"
    cv2.imwrite(str(path), smooth)
    return path


def test_samples_have_the_statistics_of_the_whole_filtered_image(tmp_path: Path) -> None:
    path = photo(tmp_path, 300, 420)
    r = encode_photograph(path, ENCODERS, name="it")
    image = torch.from_numpy(np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])).float() / 255
    for encoder, samples in ((CONTENT, r.content), (SEMANTIC, r.semantic)):
        maps = encoder(image.permute(2, 0, 1)[None])[0]
        full = upsample(maps, image, radius=round(0.08 * 300), eps=1e-3, stride=4).flatten(0, 1)
        # Projected after the filter here, before it there: both are linear.
        full = BASIS.project(full) if encoder is SEMANTIC else full
        sigma = full.std(0)
        assert 10_000 < len(samples) < 40_000
        assert float(((samples.mean(0) - full.mean(0)).abs() / sigma).max()) < 0.03
        assert float((samples.std(0) / sigma - 1).abs().max()) < 0.05


def test_a_photograph_on_its_side_is_the_upright_one_bit_for_bit(tmp_path: Path) -> None:
    stored = cv2.imread(str(photo(tmp_path, 96, 128)))
    mask = np.zeros((96, 128, 3), np.uint8)
    mask[:40, :90] = 255
    for name, pixels in (("photo", stored), ("mask", mask)):
        upright = turned_jpeg(tmp_path / f"{name}.jpg", pixels, 6)
        cv2.imwrite(str(tmp_path / f"{name}.png"), upright[:, :, ::-1])
    for masked in (False, True):
        turned, plain = (
            encode_photograph(
                tmp_path / f"photo.{kind}",
                ENCODERS,
                name="it",
                mask=tmp_path / f"mask.{kind}" if masked else None,
            )
            for kind in ("jpg", "png")
        )
        for a, b in zip(turned[1:3], plain[1:3], strict=True):
            assert isinstance(a, torch.Tensor) and torch.equal(a, b)
        assert (
            turned.colour is not None
            and plain.colour is not None
            and torch.equal(turned.colour, plain.colour)
        )


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 700), (700, 3), (64, 64), (65, 1000)])
def test_any_shape_gives_a_dictionary(tmp_path: Path, height: int, width: int) -> None:
    r = encode_photograph(photo(tmp_path, height, width), ENCODERS, name="it")
    assert len(r.content) == len(r.semantic) > 0
    assert all(bool(t.isfinite().all()) for t in build_dictionary([r])[:6])


def two_halves(
    folder: Path, *, mask_size: tuple[int, int] = (80, 120), white: int = 255
) -> tuple[Path, Path]:
    """A photograph that is dark on the left and light on the right, and a mask of its right half."""
    image = np.zeros((80, 120, 3), np.uint8)
    image[:, :60], image[:, 60:] = (30, 40, 50), (210, 200, 190)
    mask = np.zeros(mask_size, np.uint8)
    mask[:, mask_size[1] // 2 :] = white
    for name, pixels in (("photo.png", image), ("mask.png", mask)):
        cv2.imwrite(str(folder / name), pixels)
    return folder / "photo.png", folder / "mask.png"


def test_a_mask_leaves_only_what_is_white(tmp_path: Path) -> None:
    path, mask = two_halves(tmp_path)
    whole, some = (
        encode_photograph(path, ENCODERS._replace(longest=120), name="it", mask=m) for m in (None, mask)
    )
    assert len(some.content) == len(some.semantic) == len(whole.content) // 2
    grid = whole.content.view(80, 120, -1)
    assert torch.equal(some.content, grid[:, 60:].reshape(-1, grid.shape[-1])), (
        "the same features, of fewer pixels"
    )


def test_unreadable_files_and_masks_that_cannot_be_are_named(tmp_path: Path) -> None:
    (tmp_path / "x.jpg").write_bytes(b"no image")
    (tmp_path / "turned").mkdir()
    cases = [
        (tmp_path / "x.jpg", None),
        two_halves(tmp_path / "turned", mask_size=(120, 80)),
        two_halves(tmp_path, white=0),
        (tmp_path / "photo.png", tmp_path / "absent.png"),
    ]
    for path, mask in cases:
        with pytest.raises(DataError, match=(mask or path).name):
            encode_photograph(path, ENCODERS, name="it", mask=mask)


def cut_out(folder: Path, name: str, hidden: tuple[int, int, int], **options: object) -> Path:
    """A noisy disc of 28 % of a picture; everything else is transparent, with a colour that must not be seen."""
    y, x = np.mgrid[0:120, 0:160]
    disc = (x - 80) ** 2 + (y - 60) ** 2 < 0.28 * 120 * 160 / np.pi
    rng = np.random.default_rng(4)
    pixels = np.where(disc[..., None], rng.integers(20, 90, (120, 160, 3)), hidden).astype(np.uint8)
    layers = np.dstack([pixels, np.uint8(255) * disc])
    path = folder / name
    image = Image.fromarray(layers)
    if name.endswith(".heic"):
        pillow_heif = pytest.importorskip("pillow_heif")
        pillow_heif.from_pillow(image).save(path, quality=100, chroma=444)
    else:
        image.save(path, **options)
    return path


def palette_cut_out(folder: Path, hidden: tuple[int, int, int]) -> Path:
    """A palette of four colours, one of them transparent (tRNS)."""
    y, x = np.mgrid[0:120, 0:160]
    disc = (x - 80) ** 2 + (y - 60) ** 2 < 0.28 * 120 * 160 / np.pi
    image = Image.fromarray(np.where(disc, 1 + (x // 10) % 3, 0).astype(np.uint8), "P")
    image.putpalette([*hidden, 80, 30, 20, 30, 70, 40, 60, 60, 20])
    image.save(folder / "palette.png", transparency=0)
    return folder / "palette.png"


KINDS_WITH_ALPHA = {
    "a.png": {},
    "a.webp": {"lossless": True, "exact": True},
    "a.tiff": {},
    "a.avif": {"quality": 100, "subsampling": "4:4:4"},
    "a.heic": {},
    "palette.png": {},
}


@pytest.mark.parametrize("kind", KINDS_WITH_ALPHA)
def test_what_is_transparent_is_neither_sampled_nor_seen(tmp_path: Path, kind: str) -> None:
    found = []
    for hidden in ((255, 255, 255), (255, 0, 255), (0, 0, 0)):
        if kind == "palette.png":
            path = palette_cut_out(tmp_path, hidden)
        else:
            path = cut_out(tmp_path, kind, hidden, **KINDS_WITH_ALPHA[kind])
        found.append(encode_photograph(path, ENCODERS._replace(longest=160), name="it"))
    lossy = kind in ("a.avif", "a.heic")
    for one in found:
        assert one.colour is not None
        assert len(one.colour) == pytest.approx(0.28 * 120 * 160, rel=0.05)
        assert float(one.colour.max()) < (0.5 if lossy else 0.36), "no colour of what is behind"
    if not lossy:  # what codecs mix across the edge is in the pixels themselves
        for one in found[1:]:
            assert torch.equal(one.content, found[0].content) and torch.equal(one.semantic, found[0].semantic)
            assert one.colour is not None and found[0].colour is not None
            assert torch.equal(one.colour, found[0].colour)


@pytest.mark.parametrize("longest", [160, 64])
def test_a_flat_thing_has_the_features_of_a_flat_picture(tmp_path: Path, longest: int) -> None:
    """At its border as in its middle, also where the photograph is reduced."""
    encoders = ENCODERS._replace(longest=longest)
    flat = np.full((120, 160, 3), (40, 90, 200), np.uint8)
    layers = np.dstack([flat, np.zeros((120, 160), np.uint8)])
    layers[37:83, 41:101, 3] = 255
    layers[layers[..., 3] == 0, :3] = 255
    Image.fromarray(flat).save(tmp_path / "flat.png")
    Image.fromarray(layers).save(tmp_path / "cut.png")
    plain = encode_photograph(tmp_path / "flat.png", encoders, name="it")
    cut = encode_photograph(tmp_path / "cut.png", encoders, name="it")
    assert len(cut.content) < len(plain.content) or longest == 64
    for a, b in ((cut.content, plain.content), (cut.semantic, plain.semantic)):
        torch.testing.assert_close(a.mean(0), b.mean(0), rtol=1e-3, atol=1e-3)
    assert cut.colour is not None
    torch.testing.assert_close(cut.colour * 255, torch.tensor([40.0, 90, 200]).expand(len(cut.colour), 3))


def test_half_opaque_counts_with_its_own_colour(tmp_path: Path) -> None:
    layers = np.zeros((64, 96, 4), np.uint8)
    layers[:, :32] = (200, 60, 30, 128)
    layers[:, 32:64] = (30, 200, 60, 127)
    layers[:, 64:] = (60, 30, 200, 255)
    Image.fromarray(layers).save(tmp_path / "a.png")
    found = encode_photograph(tmp_path / "a.png", ENCODERS._replace(longest=128), name="it")
    assert found.colour is not None
    rows = (found.colour * 255).round().int().unique(dim=0).tolist()
    assert rows == [[60, 30, 200], [200, 60, 30]]


def test_nothing_opaque_is_refused(tmp_path: Path) -> None:
    for value, dots in ((0, 0), (127, 0), (0, 5)):
        layers = np.full((100, 100, 4), (90, 90, 90, value), np.uint8)
        layers[0, :dots, 3] = 255
        Image.fromarray(layers).save(tmp_path / "clear.png")
        with pytest.raises(DataError, match=r"clear\.png: 0\.\d\d% of its pixels are opaque"):
            encode_photograph(tmp_path / "clear.png", ENCODERS, name="it")


def test_a_mask_of_a_cut_out_leaves_what_is_opaque(tmp_path: Path) -> None:
    path = cut_out(tmp_path, "a.png", (255, 255, 255))
    half = np.zeros((120, 160), np.uint8)
    half[:, :80] = 255
    Image.fromarray(half).save(tmp_path / "left.png")
    encoders = ENCODERS._replace(longest=160)
    whole = encode_photograph(path, encoders, name="it")
    left = encode_photograph(path, encoders, name="it", mask=tmp_path / "left.png")
    assert len(left.content) == pytest.approx(len(whole.content) / 2, rel=0.05)
    assert left.colour is not None and float(left.colour.max()) < 0.36
    half[:] = 0
    half[:10, :10] = 255
    Image.fromarray(half).save(tmp_path / "corner.png")
    with pytest.raises(DataError, match=r"corner\.png: the mask selects only what is transparent in a\.png"):
        encode_photograph(path, encoders, name="it", mask=tmp_path / "corner.png")
