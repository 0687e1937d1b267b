"""The local frame: 0 for what lies near 0, else an origin that is taken off and added again without loss."""

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from fprf.errors import DataError
from fprf.rendering.local_frame import added_and_beside, extent_of, local_origin, offset_file, read_offset, write_offset

shifts = st.tuples(*(st.floats(-1e7, 1e7) for _ in range(3)))


def cloud(seed: int, size: float) -> torch.Tensor:
    return size * torch.randn(40, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@given(seed=st.integers(0, 2**31), shift=shifts, size=st.sampled_from([1e-3, 1.0, 50.0, 1e4]))
def test_float32_resolves_a_millionth_of_the_extent_about_the_origin(
    seed: int, shift: tuple[float, float, float], size: float
) -> None:
    place = cloud(seed, size) + torch.tensor(shift, dtype=torch.float64)
    origin = torch.tensor(local_origin(place), dtype=torch.float64)
    local = place - origin
    middle, extent = extent_of(place)
    assert float((local.float().double() - local).norm(dim=1).quantile(0.9)) < 1.5e-6 * extent
    assert float((local + origin - place).abs().max()) <= 1e-15 * float(place.abs().max())
    if size >= 1:
        assert torch.equal(origin, origin.round()), "whole numbers, which a user can read"
    if not bool(origin.any()):
        assert float(middle.norm()) <= 16 * extent


def test_what_lies_near_0_stays_where_it_is() -> None:
    near = cloud(0, 1.0) + torch.tensor([10.0, 0, 0], dtype=torch.float64)
    assert local_origin(near) == (0, 0, 0)
    assert local_origin(torch.zeros(0, 3)) == local_origin(torch.full((5, 3), 7e6)) == (0, 0, 0)
    # Cameras in one corner of what they see: the extent is that of the points.
    far = 0.01 * cloud(0, 1.0) + torch.tensor([10.0, 0, 0], dtype=torch.float64)
    assert local_origin(far) != (0, 0, 0) and local_origin(far, cloud(1, 10.0)) == (0, 0, 0)


def test_outliers_and_numbers_that_are_not_finite_decide_nothing() -> None:
    place = cloud(0, 1.0)
    place[0], place[1], place[2] = 1e9, math.inf, math.nan
    assert local_origin(place) == (0, 0, 0)
    x, y, z = local_origin(place + torch.tensor([5e5, 0, 0], dtype=torch.float64))
    assert abs(x - 5e5) < 2 and abs(y) < 2 and abs(z) < 2


def test_offset_files_are_read_again_and_do_not_outlive_their_file(tmp_path: Path) -> None:
    path, offset = tmp_path / "a.splat", (500000.0, -0.0009765625, 5.6e6)
    assert read_offset(path) == (0, 0, 0)
    write_offset(path, offset)
    assert offset_file(path).name == "a.splat.offset.json" and read_offset(path) == offset
    write_offset(path, (0.0, 0.0, 0.0))
    assert not offset_file(path).exists()
    assert added_and_beside(offset, False) == (offset, (0, 0, 0)) and added_and_beside(offset, True) == ((0, 0, 0), offset)


@pytest.mark.parametrize("text", ["[]", "{}", '{"offset": [1, 2]}', '{"offset": "far"}', '{"offset": [1, 2, null]}', "{"])
def test_damaged_offset_files_are_refused(tmp_path: Path, text: str) -> None:
    offset_file(tmp_path / "a.ply").write_text(text)
    with pytest.raises(DataError, match=r"a\.ply\.offset\.json"):
        read_offset(tmp_path / "a.ply")
