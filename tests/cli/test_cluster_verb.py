"""`fprf cluster` says how to start a cluster: with a token, without usage statistics, on the machines that are named."""

import pytest

from fprf.cli.cluster import run


def test_the_lines_name_the_machine_and_keep_to_the_rules(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--head", "node7", "--port", "7001"]) == 0
    said = capsys.readouterr().out
    assert "ray start --head --port 7001" in said and "ray start --address node7:7001" in said
    starts = [line for line in said.splitlines() if "export " in line]
    assert len(starts) == 2
    assert all("RAY_USAGE_STATS_ENABLED=0" in line and "RAY_AUTH_MODE=token" in line for line in starts)
    assert "HEAD" not in said
