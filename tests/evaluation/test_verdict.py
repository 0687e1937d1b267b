"""What a document is told to mean: goals, pages, line-ups. No scene takes part."""

from typing import Any

import pytest
import torch

from benchmarks.paper import paper_page
from benchmarks.paper_styles import PaperConfig
from fprf.errors import ConfigError
from fprf.evaluation.config import RestyleConfig
from fprf.evaluation.peer import peer_page
from fprf.evaluation.restyle import FLAT, GLOBAL, GOALS, PLAIN, lineup, restyle_page, transfers, verdict
from fprf.evaluation.town_truth import Row
from fprf.plugins.stylizers.config import RegionOtConfig, RegionToneConfig

PROVENANCE = {"commit": "0123abcd", "fprf": "0.1.0", "torch": "2.0", "machine": "2 x86-64 cores"}


def rows(ours: float, **others: float) -> dict[str, Row]:
    found: dict[str, Row] = {name: {"psnr": 10.0, "match_inside": None, "consistency": 0.0} for name in (PLAIN, FLAT, *GLOBAL)}
    for name, value in others.items():
        found[{"flat": FLAT}.get(name, name)]["psnr"] = value
    return found | {"best": {"psnr": ours, "match_inside": 0.95, "consistency": 0.01}}


def test_every_goal_is_judged_on_its_own() -> None:
    found = verdict(rows(14.0, adain=12.0, reinhard=11.0, flat=13.5), "best")
    assert found["best_global"] == "adain"
    assert found["reached"] == {
        "over_no_change_db": 4.0, "over_best_global_db": 2.0, "over_2d_db": 0.5, "match_inside": 0.95, "consistency": 0.01,
    }  # fmt: skip
    assert found["met"] == {
        "over_no_change_db": True, "over_best_global_db": True, "over_2d_db": False, "match_inside": True, "consistency": True,
    }  # fmt: skip
    assert found["goals"] == dict(GOALS)


def test_less_is_better_for_consistency_alone() -> None:
    shaky = rows(20.0)
    shaky["best"] |= {"consistency": 0.06, "match_inside": 0.89}
    met = verdict(shaky, "best")["met"]
    assert not met["consistency"] and not met["match_inside"] and met["over_no_change_db"]
    shaky["best"]["consistency"] = None
    assert verdict(shaky, "best")["met"]["consistency"] is None, "not known is neither met nor missed"


def test_the_recommended_comes_last_and_takes_the_place_of_its_like() -> None:
    usual = lineup(RegionToneConfig())
    assert list(usual)[-1] == "region-tone" and "nearest-code" in usual
    changed = lineup(RegionOtConfig(temperature=0.1))
    assert list(changed)[-1] == "region-ot" and set(changed) == set(usual)
    assert changed["region-ot"] == RegionOtConfig(temperature=0.1)


def test_transfers_take_all_pixels_of_all_references() -> None:
    draw = torch.Generator().manual_seed(0)
    plain = [torch.rand(6, 8, 3, generator=draw) for _ in range(2)]
    dark, light = (torch.rand(5, 5, 3, generator=draw) * 0.2 + at for at in (0.0, 0.7))
    found = transfers(plain, [dark, light])
    assert set(found) == {"reinhard", "histogram"}
    for shown in found.values():
        assert [x.shape for x in shown.pictures] == [(6, 8, 3)] * 2 and shown.taken is None
    every = torch.cat([dark, light]).mean()
    assert float(found["histogram"].pictures[0].mean()) == pytest.approx(float(every), abs=0.03)


def document() -> dict[str, Any]:
    table = {name: {"psnr": 12.0, "match_inside": 0.5} for name in ("a", "b")}
    return {
        "settings": {
            "method": "m", "trained_steps": 1, "train_seconds": 2.0, "town_seed": 0, "trained_palette": "day",
            "reference_seeds": [1, 2, 3], "seed": 0, "views": 1, "frames": 8, "view_size": [12, 9],
        },
        "provenance": PROVENANCE,
        "recommended": "b",
        "reconstruction": {"psnr": 20.0, "ssim": 0.5, "delta_e": 3.0},
        "means": {"one": table, "three": table},
        "verdict": {
            "goals": dict(GOALS), "reached": dict.fromkeys(GOALS, 1.0) | {"match_inside": None},
            "met": dict.fromkeys(GOALS, True) | {"match_inside": None, "over_2d_db": False}, "best_global": "a",
        },
        "palettes": {
            light: {"three": {"rows": table, "delta_e_by_class": {name: {"sky": n, "lawn": 2 * n} for name in table}}}
            for n, light in enumerate(("night", "noon"), 1)
        },
    }  # fmt: skip


def test_the_page_says_what_was_met_and_what_was_not() -> None:
    text = restyle_page(document(), picture="all.jpg")
    assert "not known" in text and "**not met**" in text and "| met |" in text
    assert "](all.jpg)" in text and "0123abcd" in text and "12x9" in text
    assert "| a | 1.5 | 3.0 |" in text, "differences of a class are means over the palettes"
    assert "![" not in restyle_page(document())


def test_a_peers_page_names_the_missing_flag() -> None:
    known = {"frames": 3, "size": [4, 3], "provenance": PROVENANCE}
    nothing = {**known, "steadiness": None, "published": None, "truth": None, "style": None, "missing": {"truth": "--truth"}}
    assert "- truth: not known without --truth" in peer_page(nothing) and "–" in peer_page(nothing)
    one = {"rmse": 0.0123, "e_warp": 1.5e-4, "lpips": None, "pairs": 2}
    some = {**nothing, "published": {"short": one, "long": {**one, "rmse": None}}, "missing": {}}
    assert "| 0.0123 |" in peer_page(some) and "1.50e-04" in peer_page(some) and "without" not in peer_page(some)


def test_a_papers_page_has_the_columns_that_it_needs() -> None:
    settings = {
        "data": "fox", "downscale": 2, "method": "m", "steps": 3, "trainings": [0, 1], "views": 4, "palettes": ["night"],
    }  # fmt: skip
    made = {"table": "reconstruction", "settings": settings, "provenance": PROVENANCE, "rows": {"frozen": {"psnr": 21.5}}}
    text = paper_page(made)
    assert "| frozen | 21.50 |" in text and "match" not in text and "*Styled*" not in text and "seeds 0, 1" in text
    made["rows"] = {"frozen": {"styled_psnr": 17.0}}
    assert "*Styled*: against the truth of the palettes night" in paper_page(made)


def test_knobs_are_checked() -> None:
    for wrong in ({"frames": 7}, {"seeds": (1, 2)}, {"blend": 1.1}, {"palettes": ()}, {"longest": 8}):
        with pytest.raises(ConfigError):
            RestyleConfig(**wrong)  # type: ignore[arg-type]
    for wrong in ({"trainings": ()}, {"clusters": (0,)}, {"steps": 0}, {"downscale": 0}):
        with pytest.raises(ConfigError):
            PaperConfig(**wrong)  # type: ignore[arg-type]
