import pytest
import torch
from fprf_contrast import ContrastConfig

from fprf.errors import ConfigError
from fprf.testing import check_encoder


def test_keeps_to_the_contract() -> None:
    check_encoder(ContrastConfig())
    check_encoder(ContrastConfig(window=4))


def test_a_flat_image_has_no_features() -> None:
    flat = torch.full((1, 3, 8, 12), 0.3)
    torch.testing.assert_close(ContrastConfig().build()(flat), torch.zeros_like(flat))


def test_ranges_are_checked() -> None:
    with pytest.raises(ConfigError, match="window"):
        ContrastConfig(window=0)
