import pytest

from fprf.io.figures import figures, number


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"), ("504 × 378", "504 × 378"), (True, "yes"), (0, "0"), (0.0, "0"), (34, "34"), (412345, "412,345"),
        (27.3128, "27.31"), (0.84123, "0.841"), (-0.5, "-0.500"), (93.24, "93.2"), (2101.3, "2,101"), (2.1e-5, "2.1e-05"),
    ],
)  # fmt: skip
def test_numbers_as_people_read_them(value: float | int | str | None, shown: str) -> None:
    assert number(value) == shown


def test_keys_become_labels_with_units() -> None:
    rows = list(
        figures({"psnr": 27.31, "seconds": 4, "peak_rss_mib": 2048, "feature_bytes": 12, "train_seconds": 1.5, "x": "y"})
    )
    assert [row.group for row in rows] == [""] * 6
    assert [(row.label, row.unit) for row in rows] == [
        ("PSNR", "dB"), ("Time", "s"), ("Peak memory", "MiB"), ("Feature", "B"), ("Train", "s"), ("X", ""),
    ]  # fmt: skip
