"""What a document is told to mean: goals, pages, line-ups. No scene takes part."""

from typing import Any

import pytest
import torch

from fprf.evaluation.restyle import FLAT, GLOBAL, GOALS, PLAIN, lineup, transfers, verdict
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
