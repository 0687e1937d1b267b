"""VGG-19 against plain loops in float64, and where its weights come from."""

import io
import math
import urllib.error
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from vgg_files import LAYERS, vgg_file, vgg_tensors

from fprf.errors import WeightsError
from fprf.plugins.encoders import vgg_weights
from fprf.plugins.encoders.config import Vgg19Config
from fprf.plugins.encoders.vgg import CONVOLUTIONS, reaches, vgg19_activations
from fprf.plugins.encoders.vgg_weights import pink_noise

Grid = list[list[list[float]]]


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise urllib.error.URLError("no network in tests")

    monkeypatch.setattr(vgg_weights.urllib.request, "urlopen", refuse)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))


def mirrored(index: int, size: int) -> int:
    return -index if index < 0 else 2 * (size - 1) - index if index >= size else index


def convolve(grid: Grid, weight: Tensor, bias: Tensor, *, reflect: bool) -> Grid:
    """3x3, one output at a time."""
    height, width = len(grid[0]), len(grid[0][0])
    kernel = weight.double().tolist()
    result = [[[float(b)] * width for _ in range(height)] for b in bias.double()]
    for o, filters in enumerate(kernel):
        for y in range(height):
            for x in range(width):
                for i, window in enumerate(filters):
                    for dy in range(3):
                        for dx in range(3):
                            yy, xx = y + dy - 1, x + dx - 1
                            if reflect:
                                yy, xx = mirrored(yy, height), mirrored(xx, width)
                            if 0 <= yy < height and 0 <= xx < width:
                                result[o][y][x] += window[dy][dx] * grid[i][yy][xx]
    return result


def pool(grid: Grid) -> Grid:
    """2x2 maxima; an odd border is pooled alone."""
    height, width = len(grid[0]), len(grid[0][0])
    return [
        [
            [
                max(plane[y][x] for y in range(2 * j, min(2 * j + 2, height)) for x in range(2 * i, min(2 * i + 2, width)))
                for i in range(-(-width // 2))
            ]
            for j in range(-(-height // 2))
        ]
        for plane in grid
    ]


def oracle(image: Tensor, layer: str, *, normalise: bool) -> Tensor:
    tensors = vgg_tensors(means=True)
    mean, std = (0.485, 0.458, 0.408), (0.5, 0.5, 0.25)
    grid = [[[(v - mean[c]) / std[c] for v in row] for row in plane] for c, plane in enumerate(image.double().tolist())]
    for place, name in LAYERS.items():
        if name in ("2_1", "3_1"):
            grid = pool(grid)
        grid = convolve(grid, tensors[f"features.{place}.weight"], tensors[f"features.{place}.bias"], reflect=normalise)
        if layer == f"conv{name}":
            break
        grid = [[[max(v, 0.0) for v in row] for row in plane] for plane in grid]
        if layer == f"relu{name}":
            break
    result = torch.tensor(grid, dtype=torch.float64)
    return result / tensors[f"mean_activation.conv{layer[4:]}"].double().view(-1, 1, 1) if normalise else result


@pytest.mark.parametrize("normalise", [True, False])
@pytest.mark.parametrize("layer", ["relu1_1", "conv1_2", "relu2_1", "conv3_1"])
def test_against_plain_loops(tmp_path: Path, layer: str, normalise: bool) -> None:
    image = torch.rand(3, 7, 5)
    encoder = Vgg19Config(layer=layer, weights=vgg_file(tmp_path), normalise=normalise).build()
    expected = oracle(image, layer, normalise=normalise)
    found = encoder(image[None])[0].double()
    assert found.shape == expected.shape
    torch.testing.assert_close(found, expected, rtol=2e-5, atol=2e-5)


def test_files_of_torchvision_take_imagenets_mean_and_std(tmp_path: Path) -> None:
    stated = vgg_tensors(means=True)
    torch.save(stated, tmp_path / "vgg.pth")
    save_file(stated, tmp_path / "bare.safetensors")
    pth, bare = (Vgg19Config(weights=tmp_path / name).build() for name in ("vgg.pth", "bare.safetensors"))
    assert pth.identity == bare.identity
    torch.testing.assert_close(pth.get_buffer("std"), torch.tensor([0.229, 0.224, 0.225]))


def test_without_mean_activations_noise_gives_them(tmp_path: Path) -> None:
    config = Vgg19Config(weights=vgg_file(tmp_path, means=False))
    encoder = config.build()
    means = vgg19_activations(encoder, pink_noise())
    alive = means > 0
    torch.testing.assert_close(means[alive], torch.ones_like(means[alive]), rtol=1e-3, atol=1e-3)
    assert encoder.identity == config.build().identity


def test_pink_noise_looks_like_photographs() -> None:
    noise = pink_noise(2, 64)
    assert noise.min() >= 0 <= 1 - noise.max()
    assert torch.equal(noise, pink_noise(2, 64))
    neighbours = torch.corrcoef(torch.stack([noise[:, 0, :, 1:].flatten(), noise[:, 0, :, :-1].flatten()]))[0, 1]
    channels = torch.corrcoef(torch.stack([noise[:, 0].flatten(), noise[:, 2].flatten()]))[0, 1]
    assert neighbours > 0.7
    assert channels > 0.7


def test_a_layer_beyond_the_file_names_those_it_has(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"relu1_1, relu1_2, relu2_1, relu2_2, relu3_1;.*--content\.encoder\.weights"):
        Vgg19Config(layer="relu4_1", weights=vgg_file(tmp_path)).build()


def test_absent_weights_say_what_to_put_where(tmp_path: Path) -> None:
    with pytest.raises(WeightsError) as raised:
        Vgg19Config().build()
    for part in ("https://download.pytorch.org/models/vgg19-dcbb9e9d.pth", "dcbb9e9d", ".cache/fprf/weights", "--content.en"):
        assert part in str(raised.value)
    assert not list((tmp_path / "home/.cache/fprf/weights").iterdir())


def test_a_download_of_another_hash_is_refused_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vgg_weights.urllib.request, "urlopen", lambda *_, **__: io.BytesIO(b"not the weights"))
    with pytest.raises(WeightsError, match="promises dcbb9e9d"):
        Vgg19Config().build()
    assert not list((tmp_path / "home/.cache/fprf/weights").iterdir())


def test_a_download_is_kept_and_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    buffer = io.BytesIO()
    torch.save(vgg_tensors(means=True), buffer)
    calls: list[str] = []

    def serve(url: str, timeout: float) -> io.BytesIO:
        calls.append(url)
        return io.BytesIO(buffer.getvalue())

    monkeypatch.setattr(vgg_weights.urllib.request, "urlopen", serve)
    monkeypatch.setattr(vgg_weights, "_expected", lambda _: None)
    assert Vgg19Config().build().identity == Vgg19Config().build().identity
    assert calls == [vgg_weights.URL]
    assert [file.name for file in (tmp_path / "home/.cache/fprf/weights").iterdir()] == [vgg_weights.FILE]


def damaged(folder: Path) -> list[tuple[Path, str]]:
    (folder / "text.safetensors").write_text("hello")
    (folder / "text.pth").write_text("hello")
    (folder / "vgg19-00000000.pth").write_text("hello")
    torch.save([1, 2], folder / "list.pth")
    save_file({"features.0.weight": torch.zeros(4)}, folder / "flat.safetensors")
    save_file(vgg_tensors(means=True), folder / "mean.safetensors", {"mean": "grey"})
    return [
        (folder / "absent.safetensors", "no such weights file"),
        (folder / "absent.pth", "no such weights file"),
        (folder / "text.safetensors", "not a readable safetensors"),
        (folder / "text.pth", "not a file of tensors"),
        (folder / "vgg19-00000000.pth", "promises 00000000"),
        (folder / "list.pth", "not named tensors"),
        (folder / "flat.safetensors", "shape"),
        (folder / "mean.safetensors", "not three numbers"),
    ]


def test_damaged_files_are_one_clear_error_each(tmp_path: Path) -> None:
    for path, message in damaged(tmp_path):
        with pytest.raises(WeightsError, match=message):
            Vgg19Config(weights=path, layer="relu1_1").build()


def test_places_are_those_of_torchvision() -> None:
    """Convolution and ReLU take two places, a pool one after each block."""
    place = 0
    for name, found in CONVOLUTIONS.items():
        if name.endswith("_1") and name != "1_1":
            place += 1
        assert found == place
        place += 2


def test_reaches_stops_at_the_first_gap() -> None:
    tensors = vgg_tensors(means=False)
    del tensors["features.5.bias"]
    assert reaches(tensors) == ["relu1_1", "relu1_2"]


def test_the_caffe_weights_have_unit_mean_activation_on_a_photograph(shared: Path) -> None:
    from fprf.pretraining.photos import load_photo

    photo = load_photo(next(iter(sorted((shared / "data/pretrain/bsds500").glob("*.jpg")))), 256).permute(2, 0, 1)[None]
    encoder = Vgg19Config(weights=shared / "weights/vgg19_imagenet.safetensors").build()
    assert encoder.channels == 128
    assert math.isclose(float(encoder(photo).mean()), 1, abs_tol=0.5)
