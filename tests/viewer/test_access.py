import pytest

from fprf.errors import UsageError
from fprf.viewer.access import COOKIE, Access, is_loopback, make_access

HERE = Access("127.0.0.1", None)
TOKEN = "a-token-of-sixteen-characters"
THERE = Access("0.0.0.0", TOKEN)


@pytest.mark.parametrize("name", ["127.0.0.1:8080", "localhost:8080", "localhost", "[::1]:8080", "127.9.8.7:1"])
def test_this_machine_by_its_names(name: str) -> None:
    assert HERE.refusal({"host": name}) is None
    assert HERE.refusal({"host": name, "origin": f"http://{name}"}) is None


@pytest.mark.parametrize("name", ["evil.example:8080", "127.0.0.1.evil.example", "", "[", "192.168.0.7:8080", "localhost.evil"])
def test_names_that_were_made_to_point_here_are_refused(name: str) -> None:
    assert HERE.refusal({"host": name}) is not None


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "", "https://localhost:8080"])
def test_pages_of_other_sites_are_refused(origin: str) -> None:
    assert HERE.refusal({"host": "127.0.0.1:8080", "origin": origin}) is not None


def test_without_a_host_nothing_goes() -> None:
    assert HERE.refusal({}) is not None and THERE.refusal({}, TOKEN) is not None


def test_from_elsewhere_a_token_is_needed_in_one_of_three_places() -> None:
    host = {"host": "machine.example:8080"}
    assert "token" in str(THERE.refusal(host))
    assert THERE.refusal(host, "wrong-token-of-16-chars") is not None
    assert THERE.refusal(host, TOKEN) is None
    assert THERE.refusal({**host, "cookie": f"other=1; {COOKIE}={TOKEN}"}) is None
    assert THERE.refusal({**host, "cookie": f"{COOKIE}=x{TOKEN}"}) is not None
    assert THERE.refusal({**host, "authorization": f"Bearer {TOKEN}"}) is None
    assert THERE.refusal({**host, "origin": "http://evil.example", "cookie": f"{COOKIE}={TOKEN}"}) is not None
    assert THERE.refusal(host, "töken-that-is-no-ascii") is not None


def test_tokens_are_made_where_they_are_needed() -> None:
    assert make_access("127.0.0.1", None).token is None
    assert make_access("localhost", TOKEN).token == TOKEN
    one, two = (make_access("0.0.0.0", None).token for _ in range(2))
    assert one is not None and two is not None and one != two and len(one) >= 32


@pytest.mark.parametrize("token", ["short", "", "with spaces in its midst", "tökentökentökentök", "line\nbreak-in-a-long"])
def test_weak_tokens_are_refused(token: str) -> None:
    with pytest.raises(UsageError, match="--token"):
        make_access("127.0.0.1", token)


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("LocalHost", True),
        ("::1", True),
        ("[::1]", True),
        ("0.0.0.0", False),
        ("::", False),
        ("a.b", False),
    ],
)
def test_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback
