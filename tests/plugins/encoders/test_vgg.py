"""VGG against torch in float64, and where its weights come from."""

import io
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from network_files import LAYERS, vgg_file, vgg_tensors
from safetensors.torch import save_file
from torch import Tensor, nn

from fprf.errors import WeightsError
from fprf.plugins.encoders import vgg
from fprf.plugins.encoders.config import Vgg19Config
from fprf.plugins.encoders.frozen import street
from fprf.plugins.encoders.vgg import FILE, ORIGIN, vgg_activations

pytestmark = pytest.mark.usefixtures("home")


def oracle(image: Tensor, layer: str, *, normalise: bool) -> Tensor:
    """Layer by layer in float64, border pixels mirrored where the network is normalised."""
    tensors = {name: value.double() for name, value in vgg_tensors(means=True).items()}
    mean, std = (torch.tensor(x).double().view(-1, 1, 1) for x in ((0.485, 0.458, 0.408), (0.5, 0.5, 0.25)))
    found = ((image.double() - mean) / std)[None]
    for place, name in LAYERS.items():
        if name in ("2_1", "3_1"):
            found = F.max_pool2d(found, 2, ceil_mode=True)
        found = F.pad(found, (1,) * 4, mode="reflect" if normalise else "constant")
        found = F.conv2d(found, tensors[f"features.{place}.weight"], tensors[f"features.{place}.bias"])
        if layer == f"conv{name}":
            break
        found = found.relu()
        if layer == f"relu{name}":
            break
    return found[0] / tensors[f"mean_activation.conv{layer[4:]}"].view(-1, 1, 1) if normalise else found[0]


@pytest.mark.parametrize("normalise", [True, False])
@pytest.mark.parametrize("layer", ["relu1_1", "conv1_2", "relu2_1", "conv3_1"])
def test_against_float64(tmp_path: Path, layer: str, normalise: bool) -> None:
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


def test_without_mean_activations_the_town_gives_them(tmp_path: Path) -> None:
    config = Vgg19Config(weights=vgg_file(tmp_path, means=False))
    encoder = config.build()
    means = vgg_activations(encoder, street())
    assert (means <= 1 + 1e-3).all()
    assert int(means.isclose(torch.ones_like(means), rtol=1e-3).sum()) >= 4  # the rest hardly ever fires
    assert encoder.identity == config.build().identity
    scale = encoder.get_buffer("scale")
    assert float(scale.min()) >= 0.04 * float(scale.mean())


def adain_network() -> nn.Sequential:
    """As AdaIN lists its layers, with few channels: an even one changes colour, then padding, convolution,
    ReLU.
    """
    layers: list[nn.Module] = [nn.Conv2d(3, 3, 1)]
    inputs = 3
    for block, depth in enumerate((2, 2, 4, 4)):
        for _ in range(depth):
            layers += [nn.ReflectionPad2d(1), nn.Conv2d(inputs, 4 + block, 3), nn.ReLU()]
            inputs = 4 + block
        layers.append(nn.MaxPool2d(2, ceil_mode=True))
    return nn.Sequential(*layers)


@pytest.mark.parametrize(
    ("layer", "upto"), [("relu1_1", 4), ("relu2_1", 11), ("relu3_1", 18), ("relu4_1", 31), ("conv2_2", 13)]
)
def test_adains_files_give_adains_features(tmp_path: Path, layer: str, upto: int) -> None:
    network = adain_network().double()
    torch.save(network.float().state_dict(), tmp_path / "vgg_normalised.pth")
    encoder = Vgg19Config(layer=layer, weights=tmp_path / "vgg_normalised.pth").build()
    image = torch.rand(2, 3, 33, 46)
    with torch.no_grad():
        expected = network.double()[:upto](image.double())
    torch.testing.assert_close(encoder(image).double(), expected, rtol=1e-4, atol=1e-5)
    assert ":normalised:" in encoder.identity


def test_adains_files_are_never_plain(tmp_path: Path) -> None:
    torch.save(adain_network().state_dict(), tmp_path / "vgg_normalised.pth")
    with pytest.raises(
        WeightsError, match=r"normalised VGG-19 of AdaIN, which cannot be made plain.*normalise on"
    ):
        Vgg19Config(weights=tmp_path / "vgg_normalised.pth", normalise=False).build()
    with pytest.raises(WeightsError, match=r"holds no conv5_1"):
        Vgg19Config(weights=tmp_path / "vgg_normalised.pth", layer="relu5_1").build()


def test_a_download_is_kept_and_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    buffer = io.BytesIO()
    torch.save(vgg_tensors(means=True), buffer)
    calls: list[str] = []

    def serve(url: str, timeout: float) -> io.BytesIO:
        calls.append(url)
        return io.BytesIO(buffer.getvalue())

    monkeypatch.setattr(vgg.urllib.request, "urlopen", serve)
    monkeypatch.setattr(vgg, "_expected", lambda _: None)
    config = Vgg19Config(layer="relu3_1")
    assert config.build().identity == config.build().identity
    assert calls == [ORIGIN]
    assert [file.name for file in (tmp_path / "home/.cache/fprf/weights").iterdir()] == [FILE]


def test_damaged_files_are_one_clear_error_each(tmp_path: Path) -> None:
    for name in ("text.safetensors", "text.pth", "vgg19-00000000.pth"):
        (tmp_path / name).write_text("hello")
    torch.save([1, 2], tmp_path / "list.pth")
    save_file({"features.0.weight": torch.zeros(4)}, tmp_path / "flat.safetensors")
    save_file(vgg_tensors(means=True), tmp_path / "mean.safetensors", {"mean": "grey"})
    every = sorted(path.name for path in tmp_path.iterdir() if path.is_file())
    assert len(every) == 6
    for name in (*every, "absent.safetensors", "absent.pth"):
        with pytest.raises(WeightsError, match=name):
            Vgg19Config(weights=tmp_path / name, layer="relu1_1").build()


def test_vgg19_ships_up_to_relu2_1(shared: Path) -> None:
    """The same features as those of the full file, and no download: the network is refused here."""
    full = shared / "weights/vgg19_imagenet.safetensors"
    image = torch.rand(1, 3, 20, 18)
    for layer in ("relu1_1", "conv1_2", "relu2_1"):
        found = Vgg19Config(layer=layer).build()
        expected = Vgg19Config(layer=layer, weights=full).build()
        assert found.identity == expected.identity
        assert torch.equal(found(image), expected(image))
    with pytest.raises(WeightsError, match="cannot be downloaded"):
        Vgg19Config(layer="relu2_2").build()
