"""What is exported, to which files."""

from pathlib import Path

import pytest

from fprf.export.config import plan


def test_a_folder_takes_the_usual_kinds_or_those_that_are_named(tmp_path: Path) -> None:
    assert plan([], tmp_path) == (("ply", "splat", "glb", "cameras", "lut"), tmp_path, None)
    assert plan(["splat", "ply", "splat"], Path("out")) == (("splat", "ply"), Path("out"), None)
    assert plan(["splats", "mesh", "spz", "glb"], Path("out")).kinds == ("ply", "splat", "glb", "spz")
    assert plan(["mesh", "compressed.ply"], Path("out")).formats == ("compressed.ply",)
    assert plan(["glb"], Path("out")).paths("mesh", "dusk", ".ply", ".glb") == [
        Path("out/mesh.dusk.ply"),
        Path("out/mesh.dusk.glb"),
    ]


@pytest.mark.parametrize(
    ("kinds", "name", "kind"),
    [
        *(([], "a.ply", "ply"), (["mesh"], "a.ply", "glb"), ([], "a.SPLAT", "splat"), ([], "t.json", "cameras")),
        *(([], "a.compressed.ply", "compressed.ply"), (["sog"], "meta.json", "sog"), (["lut"], "a.cube", "lut")),
    ],
)
def test_a_file_holds_what_its_ending_says(kinds: list[str], name: str, kind: str) -> None:
    assert plan(kinds, Path("to") / name) == ((kind,), Path("to"), Path("to") / name)
    assert plan(kinds, Path("to") / name).paths("splats", "dusk", ".x") == [Path("to") / name]
