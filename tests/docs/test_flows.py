"""The drawings of docs/design.md are of the code as it is."""

import pytest

from tools.flows import FLOWS, FOLDER, ROOT, drawing


@pytest.mark.parametrize("name", FLOWS)
def test_the_drawing_is_of_this_code(name: str) -> None:
    drawn = (FOLDER / f"flow-{name}.svg").read_text("utf-8")
    assert drawn == drawing(FLOWS[name]), "draw it anew: python -m tools.flows"


@pytest.mark.parametrize("name", FLOWS)
def test_functions_of_scripts_exist(name: str) -> None:
    for lane in FLOWS[name]:
        for step in lane.steps:
            file, _, function = step.code.partition(":")
            if step.is_script:
                assert f"  {function}(" in (ROOT / file).read_text("utf-8"), step.code
