"""What ships, measured on photographs that it did not learn from."""

from pathlib import Path
from typing import get_args

import pytest
import torch
import torch.nn.functional as F

from fprf.plugins.decoders.config import MlpDecoderConfig, Objective
from fprf.plugins.encoders.config import (
    BundledContentConfig,
    BundledSemanticConfig,
    EncoderConfig,
    Vgg19Config,
)
from fprf.pretraining.decoder import decoder_report
from fprf.pretraining.photos import find_photos, load_photo, split
from tools.distil.examples import nightfall


@pytest.fixture(scope="module")
def photos(shared: Path) -> tuple[list[Path], list[Path]]:
    """Learned from and held out, as in training."""
    return split(find_photos([shared / "data/pretrain"]))


@pytest.mark.parametrize("objective", get_args(Objective))
@pytest.mark.parametrize("config", [Vgg19Config(), BundledContentConfig()])
def test_photographs_survive_encoding_and_decoding(
    photos: tuple[list[Path], list[Path]], config: EncoderConfig, objective: Objective
) -> None:
    encoder = config.build()
    decoder = MlpDecoderConfig(objective=objective).build(encoder=encoder.identity, channels=encoder.channels)
    report = decoder_report(encoder, decoder, photos[1][:3])
    assert float(report["psnr_db"]) >= (32 if objective == "identity" else 31)
    assert float(report["psnr_worst_db"]) >= 28


def test_day_and_night_agree_better_than_their_colours_do(photos: tuple[list[Path], list[Path]]) -> None:
    encoder = BundledSemanticConfig().build()
    generator = torch.Generator().manual_seed(0)
    features = []
    colours = []
    for path in photos[1][:6]:
        day = load_photo(path).permute(2, 0, 1)[None]
        night = nightfall(day[0], generator)[None]
        features.append(F.cosine_similarity(encoder(day), encoder(night), dim=1).mean())
        flat = [F.avg_pool2d(image, 8) - 0.5 for image in (day, night)]
        colours.append(F.cosine_similarity(flat[0], flat[1], dim=1).mean())
    assert torch.stack(features).mean() > torch.stack(colours).mean() + 0.2
    assert torch.stack(features).mean() > 0.6
