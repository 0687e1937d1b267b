"""Reports judge what users get: their defaults are those of styles. Mistakes are named."""

from dataclasses import fields
from typing import Any, get_args, get_type_hints

import pytest

from fprf.errors import ConfigError
from fprf.evidence.config import EvidenceConfig, PaperConfig, PeerConfig, RestyleConfig
from fprf.evidence.paper import TRAINED
from fprf.evidence.paper_page import paper_page
from fprf.evidence.paper_styles import ONE_TRAINING
from fprf.style.config import StyleConfig
from fprf.style.dictionary import BLEND, CLUSTERS

TABLES = get_args(get_type_hints(PaperConfig)["table"])


def test_styles_are_judged_as_they_are_made() -> None:
    style = StyleConfig()
    assert RestyleConfig().stylizer == style.stylizer
    for judged in (RestyleConfig().blend, PaperConfig().blend):
        assert judged == style.blend == BLEND
    for judged in (RestyleConfig().clusters, PaperConfig().codes):
        assert judged == style.clusters == CLUSTERS


def test_every_table_can_be_made_and_has_words() -> None:
    assert set(TABLES) == {*TRAINED, *ONE_TRAINING} and not set(TRAINED) & set(ONE_TRAINING)
    settings: dict[str, Any] = {
        "data": "town", "downscale": 1, "method": "m", "steps": 3, "trainings": [0], "views": 4, "palettes": ["night"],
    }  # fmt: skip
    known = {"commit": "0123abcd", "fprf": "0.1.0", "torch": "2.0", "machine": "2 x86-64 cores"}
    pages = [
        paper_page({"table": name, "settings": settings, "provenance": known, "rows": {"a": {"styled_psnr": 17.0}}})
        for name in TABLES
    ]
    words = [page.split("\n\n")[1] for page in pages]
    assert len(set(words)) == len(TABLES), "each says what it is about"
    assert all("0123abcd" in page and "seeds 0" in page for page in pages)


@pytest.mark.parametrize(
    ("config", "name", "value"),
    [
        (RestyleConfig, "minutes", 0.0),
        (RestyleConfig, "views", 0),
        (RestyleConfig, "frames", 7),
        (RestyleConfig, "longest", 15),
        (RestyleConfig, "clusters", 0),
        (RestyleConfig, "blend", -0.1),
        (PaperConfig, "downscale", 0),
        (PaperConfig, "steps", 0),
        (PaperConfig, "views", 0),
        (PaperConfig, "codes", 0),
        (PaperConfig, "blend", 1.1),
    ],
)
def test_what_is_out_of_range_is_named(config: type[EvidenceConfig], name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=f"{name}.*{value}"):
        config(**{name: value})


@pytest.mark.parametrize("config", [RestyleConfig, PaperConfig])
def test_lists_that_must_hold_something(config: type[EvidenceConfig]) -> None:
    names = {field.name for field in fields(config)}
    for name in names & {"palettes", "seeds", "trainings"}:
        with pytest.raises(ConfigError, match=name):
            config(**{name: ()})  # type: ignore[arg-type]


def test_configs_are_fixed_once_they_are_made() -> None:
    for config in (RestyleConfig(), PaperConfig(), PeerConfig()):
        with pytest.raises(AttributeError):
            config.output = None  # type: ignore[misc]
