"""Both forms of the march: the compiled one, which float32 on a CPU without gradients takes, and the plain one."""

import pytest

from fprf.rendering import renderer


@pytest.fixture(params=["compiled", "plain"])
def form(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Which form the renderer takes in this test."""
    name: str = request.param
    if name == "plain":
        monkeypatch.setattr(renderer.compiled, "usable", lambda *given: False)
    return name
