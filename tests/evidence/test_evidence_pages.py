"""Tables, sheets and where figures come from."""

from pathlib import Path

import numpy as np
import torch

from fprf.evidence.contact import contact_sheet
from fprf.evidence.provenance import commit, provenance, words
from fprf.evidence.table import markdown, printed

COLUMNS = (("psnr", "PSNR dB", ".2f"), ("match", "match", ".1%"))


def test_tables_say_what_is_missing() -> None:
    rows = {"ours": {"psnr": 17.234, "match": 0.9}, "none": {"psnr": None}}
    text = markdown(rows, COLUMNS, first="method")
    assert text.splitlines() == [
        "| method | PSNR dB | match |",
        "|---|---:|---:|",
        "| ours | 17.23 | 90.0% |",
        "| none | – | – |",
    ]
    assert printed("a title", rows, COLUMNS).row_count == 2


def test_sheets_place_pictures_by_row_and_column() -> None:
    red, blue = torch.zeros(10, 20, 3), torch.zeros(20, 20, 3)
    red[..., 0], blue[..., 2] = 1, 1
    page = contact_sheet({"first": [red, blue], "second": [blue]}, ["a", "b"], height=20)
    assert page.shape == (18 + 2 * 23, 62 + 40 + 3 + 20 + 3, 3)
    assert (page[18:38, 62:102] == (255, 0, 0)).all() and (page[18:38, 105:125] == (0, 0, 255)).all()
    assert (page[41:61, 62:82] == (0, 0, 255)).all() and (page[41:61, 105:] == 255).all()
    assert np.any(page[:18] != 255) and np.any(page[18:38, :62] != 255), "names are written"


def test_provenance_is_a_line(tmp_path: Path) -> None:
    found = provenance("cpu")
    assert found["torch"] == torch.__version__ and "cores" in str(found["machine"])
    assert str(found["machine"]) in words(found)
    assert commit(tmp_path) is None
    assert words({**found, "commit": None}).startswith("fprf ")
