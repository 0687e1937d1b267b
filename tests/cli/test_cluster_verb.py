"""`fprf cluster` says how to start a cluster: with a token, without usage statistics, on the machines that are named."""

import pytest

from fprf.cli.cluster import run
from fprf.errors import FprfError


def test_the_lines_name_the_machine_and_keep_to_the_rules(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--head", "node7", "--port", "7001"]) == 0
    said = capsys.readouterr().out
    assert "ray start --head --port 7001" in said and "ray start --address node7:7001" in said
    starts = [line for line in said.splitlines() if "export " in line]
    assert len(starts) == 2
    assert all("RAY_USAGE_STATS_ENABLED=0" in line and "RAY_AUTH_MODE=token" in line for line in starts)
    assert "HEAD" not in said


def test_columns_stay_in_line(capsys: pytest.CaptureFixture[str]) -> None:
    for head in ("a", "HEAD", "10.0.0.17"):
        assert run(["--head", head]) == 0
        lines = capsys.readouterr().out.splitlines()
        steps = [line for line in lines if line[:5].strip().rstrip(".").isdigit()]
        assert len(steps) == 5
        assert {len(line[:31]) - len(line[:31].rstrip()) >= 1 for line in steps} == {True}


def test_ports_that_need_privileges_are_refused() -> None:
    with pytest.raises(FprfError, match="port"):
        run(["--port", "80"])
