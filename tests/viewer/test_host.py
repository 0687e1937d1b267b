import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from fprf.errors import UsageError
from fprf.viewer.access import make_access
from fprf.viewer.host import Host


def page_of(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=60) as answer:
        body: bytes = answer.read()
        return body


def test_before_the_scene_is_there_a_page_says_so_and_a_visit_is_known() -> None:
    with Host(make_access("127.0.0.1", None), 0, eager=False) as host:
        assert not host.visited.is_set() and not host.open_to_others
        assert b"Loading the scene" in page_of(host.address) and host.visited.is_set()
        host.say("nobody hears this")


def test_after_its_end_nothing_listens() -> None:
    with Host(make_access("127.0.0.1", None), 0, eager=False) as host:
        address = host.address
    with pytest.raises(OSError):
        page_of(address)


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_the_address_is_one_that_this_machine_can_open(host: str) -> None:
    try:
        found = Host(make_access(host, None), 0, eager=False)
    except UsageError:
        pytest.skip("no such addresses on this machine")
    with found:
        assert found.open_to_others and found.address.startswith("http://127.0.0.1:") and "?token=" in found.address


def test_the_address_carries_the_token_and_without_it_nothing_opens() -> None:
    with Host(make_access("127.0.0.1", "a token/of & characters".replace(" ", "-")), 0, eager=False) as host:
        assert "?token=a-token/of-%26-characters" in host.address
        with pytest.raises(urllib.error.HTTPError, match="403"):
            page_of(host.address.partition("?")[0])
        assert not host.visited.is_set()


def test_a_port_can_be_had_once() -> None:
    with Host(make_access("127.0.0.1", None), 0, eager=False) as host:
        port = int(host.address.rstrip("/").rpartition(":")[2])
        with pytest.raises(UsageError, match="choose another port"):
            Host(make_access("127.0.0.1", None), port, eager=False)


def test_what_loading_raises_reaches_the_caller_and_the_door_stays(tmp_path: Path) -> None:
    def load() -> None:
        raise UsageError("no such run")

    with Host(make_access("127.0.0.1", None), 0) as host:
        with pytest.raises(UsageError, match="no such run"):
            host.open(load, (), 64)  # type: ignore[arg-type]
        assert b"Loading" in page_of(host.address)
        time.sleep(0.05)
