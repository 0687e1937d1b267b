import pytest
import torch
from torch import Tensor

from benchmarks.style_runs import GOALS, PLAIN, RECOMMENDED, Exhibit, Row, colour_baselines, judge_exhibit, mean_rows, verdict
from fprf.errors import DataError
from fprf.evaluation.restyle import STYLIZERS
from fprf.interfaces import Encoder
from fprf.plugins.encoders.config import RandomConfig

REGIONS = (torch.arange(24) >= 12).long().expand(20, 24)


def view(seed: int, tint: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> Tensor:
    noise = torch.rand(20, 24, 1, generator=torch.Generator().manual_seed(seed))
    return torch.tensor(tint) * (0.5 + noise)


@pytest.fixture(scope="module")
def judges() -> dict[str, Encoder]:
    return {"fine": RandomConfig(channels=6, stride=1).build(), "coarse": RandomConfig(channels=6, stride=2).build()}


@pytest.fixture(scope="module")
def exhibit() -> Exhibit:
    plain, references = [view(0), view(1)], [view(2, (0.6, 0.3, 0.1)), view(3, (0.5, 0.3, 0.1))]
    ruined = [torch.rand(20, 24, 3, generator=torch.Generator().manual_seed(9)) for _ in plain]
    styled = {PLAIN: plain, **colour_baselines(plain, references), "ruined": ruined}
    return Exhibit(plain, styled, [REGIONS] * 2, references, [REGIONS] * 2)


def test_no_change_keeps_everything_and_gains_nothing(exhibit: Exhibit, judges: dict[str, Encoder]) -> None:
    rows = judge_exhibit(exhibit, judges, full=True)
    for name in ("structure", "ssim", "style_distance", "style_distance_fine", "full_distance", "full_distance_coarse"):
        assert rows[PLAIN][name] == pytest.approx(1.0, abs=1e-6)


def test_transfers_come_nearer_and_noise_loses_the_structure(exhibit: Exhibit, judges: dict[str, Encoder]) -> None:
    rows = judge_exhibit(exhibit, judges)
    for name in ("reinhard", "histogram"):
        assert _number(rows[name]["style_distance"]) < 0.7
        assert _number(rows[name]["structure"]) > 0.9
    assert _number(rows["ruined"]["structure"]) < 0.2
    assert "full_distance" not in rows["reinhard"]
    parts = [_number(rows["reinhard"][f"style_distance_{judge}"]) for judge in judges]
    assert rows["reinhard"]["style_distance"] == pytest.approx(sum(parts) / 2)


def test_every_view_needs_its_pictures(exhibit: Exhibit, judges: dict[str, Encoder]) -> None:
    with pytest.raises(DataError, match="a picture of each view"):
        judge_exhibit(exhibit._replace(styled={PLAIN: exhibit.plain[:1]}), judges)
    with pytest.raises(DataError, match="its regions"):
        judge_exhibit(exhibit._replace(reference_regions=[]), judges)


def test_baselines_see_all_references_and_each_view_alone() -> None:
    plain, references = [view(0), view(1)], [view(2, (0.9, 0.1, 0.1)), view(3, (0.1, 0.1, 0.9))]
    both = colour_baselines(plain, references)
    assert set(both) == {"reinhard", "histogram"}
    assert both["histogram"][0].equal(colour_baselines(plain[:1], references)["histogram"][0])
    assert both["histogram"][0].equal(colour_baselines(plain, references[::-1])["histogram"][0])
    middle = torch.cat([image.reshape(-1, 3) for image in references]).mean(0)
    assert torch.allclose(both["histogram"][1].mean((0, 1)), middle, atol=1e-3)


def test_means_leave_out_what_is_unknown() -> None:
    contests: list[dict[str, Row]] = [{"a": {"x": 1.0, "y": None}}, {"a": {"x": 2.0, "y": 4.0}}, {"a": {"x": 6.0, "y": None}}]
    assert mean_rows(contests) == {"a": {"x": 3.0, "y": 4.0}}
    assert mean_rows([{"a": {"y": None}}]) == {"a": {"y": None}}


@pytest.mark.parametrize(
    ("distance", "structure", "met"),
    [(0.69, 0.9, True), (0.71, 0.9, False), (0.5, 0.881, True), (0.5, 0.87, False)],
)
def test_the_verdict_needs_both(distance: float, structure: float, met: bool) -> None:
    rows: dict[str, Row] = {name: {"style_distance": 1.0, "structure": 0.9} for name in GOALS}
    rows[RECOMMENDED] = {"style_distance": distance, "structure": structure}
    found = verdict(rows)
    assert found["adain"]["met"] is met
    assert found["adain"]["nearer_share"] == pytest.approx(1 - distance)
    assert found["adain"]["structure_lost"] == pytest.approx(0.9 - structure)


def test_an_unknown_distance_decides_nothing() -> None:
    rows: dict[str, Row] = {name: {"style_distance": None, "structure": 0.9} for name in (*GOALS, RECOMMENDED)}
    assert verdict(rows)["adain"]["met"] is None


def test_the_recommended_one_takes_part() -> None:
    assert RECOMMENDED in STYLIZERS
    assert set(GOALS) <= set(STYLIZERS)


def _number(value: float | None) -> float:
    assert value is not None
    return value
