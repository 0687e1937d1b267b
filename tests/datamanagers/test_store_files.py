"""Coefficients on disk: half precision is enough, and a file is right or absent."""

import os
import time
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fprf.datamanagers import features as store_files


@settings(max_examples=25, deadline=None)
@given(
    channels=st.integers(1, 19),
    offset=st.sampled_from([0.0, 1.0, -1e3, 1e6]),
    size=st.sampled_from([1e-12, 1e-3, 1.0, 1e8]),
    seed=st.integers(0, 99),
)
def test_half_precision_keeps_eleven_bits_of_the_largest_coefficient(
    channels: int, offset: float, size: float, seed: int
) -> None:
    """Whatever the magnitudes: no overflow, no offset that eats the signal."""
    generator = torch.Generator().manual_seed(seed)
    coefs = size * torch.randn(3, 4, channels, 4, generator=generator)
    coefs[..., 3] += offset * size
    entry = store_files.pack(coefs, (30, 40))
    assert entry.coefs.dtype == torch.float16 and entry.coefs.shape[-1] % store_files.LANES == 0
    assert torch.isfinite(entry.coefs).all()
    error = (entry.plain() - coefs).abs().amax((0, 1, 3))
    # b is kept at mid-grey: its own rounding and that of three halved slopes.
    assert (error <= 2.5 * store_files.TOP * 2.0**-11 * entry.scale + 2.0**-22 * abs(offset) * size).all()


def test_constant_and_zero_features() -> None:
    coefs = torch.zeros(2, 2, 3, 4)
    coefs[..., 3] = torch.tensor([0.0, 5.0, -2.0])
    assert torch.equal(store_files.pack(coefs, (2, 2)).plain(), coefs)


def make(folder: Path) -> tuple[str, store_files.Entry]:
    entry = store_files.pack(torch.randn(3, 4, 5, 4), (30, 40))
    key = store_files.digest("some", "inputs")
    store_files.write_entry(folder, key, entry)
    return key, entry


def test_through_a_file_and_back(tmp_path: Path) -> None:
    key, entry = make(tmp_path)
    again = store_files.read_entry(tmp_path, key)
    assert again is not None
    assert all(torch.equal(a, b) for a, b in zip(entry, again, strict=True))
    assert [p.name for p in tmp_path.iterdir()] == [f"{key}.safetensors"]


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_flipped_bit_or_a_lost_end_makes_the_entry_absent(tmp_path: Path, share: float) -> None:
    key, _ = make(tmp_path)
    path = tmp_path / f"{key}.safetensors"
    data = path.read_bytes()
    at = int(share * len(data))
    path.write_bytes(data[:at] + bytes([data[at] ^ 16]) + data[at + 1 :])
    assert store_files.read_entry(tmp_path, key) is None
    path.write_bytes(data[:at])
    assert store_files.read_entry(tmp_path, key) is None
    path.write_bytes(data)
    assert store_files.read_entry(tmp_path, key) is not None


def test_a_file_under_another_name_is_not_believed(tmp_path: Path) -> None:
    key, _ = make(tmp_path)
    other = store_files.digest("other inputs")
    (tmp_path / f"{key}.safetensors").rename(tmp_path / f"{other}.safetensors")
    assert store_files.read_entry(tmp_path, key) is None
    assert store_files.read_entry(tmp_path, other) is None


def test_tensors_that_are_no_entry_are_absent(tmp_path: Path) -> None:
    store_files.write_tensors(tmp_path, "key", {"coefs": torch.zeros(2)})
    assert store_files.read_entry(tmp_path, "key") is None
    assert store_files.read_tensors(tmp_path, "key") is not None


def test_keys_do_not_run_into_each_other() -> None:
    assert store_files.digest("ab", "c") != store_files.digest("a", "bc")
    assert store_files.digest("ab") == store_files.digest(b"ab")


def test_only_old_unfinished_files_are_removed(tmp_path: Path) -> None:
    old, young, kept = tmp_path / ".a.0000.safetensors", tmp_path / ".b.0000.safetensors", tmp_path / "c.safetensors"
    for path in (old, young, kept):
        path.write_bytes(b"x")
    for path in (old, kept):
        os.utime(path, (time.time() - 7200,) * 2)
    store_files.remove_stale(tmp_path)
    assert not old.exists() and young.exists() and kept.exists()


def test_what_was_used_longest_ago_goes_first_and_what_is_in_use_stays(tmp_path: Path) -> None:
    keys = [store_files.digest(str(k)) for k in range(5)]
    for age, key in enumerate(keys):
        store_files.write_tensors(tmp_path, key, {"x": torch.zeros(1000)})
        os.utime(tmp_path / f"{key}.safetensors", (1e9 - age, 1e9 - age))
    size = (tmp_path / f"{keys[0]}.safetensors").stat().st_size
    assert store_files.read_tensors(tmp_path, keys[4]) is not None, "which makes it the youngest"
    store_files.keep_within(tmp_path, 3 * size, {keys[3]})
    assert {path.stem for path in tmp_path.iterdir()} == {keys[0], keys[3], keys[4]}
    store_files.keep_within(tmp_path, 0, {keys[3], keys[4]})
    assert {path.stem for path in tmp_path.iterdir()} == {keys[3], keys[4]}
