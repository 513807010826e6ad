"""Who is answered: this machine's browser and its own page, and elsewhere who knows the token."""

from __future__ import annotations

import pytest

from tracking3d.errors import InputError
from tracking3d.ui.web.access import Access

PORT = 8080
OURS = {"path": "/", "host": "127.0.0.1:8080", "origin": None, "cookie": None}
ELSEWHERE = Access("0.0.0.0", "secret")


def refused(access: Access, from_page: bool = False, **told) -> int:
    """The status of the refusal, or 0."""
    refusal = access.refusal(**{**OURS, **told}, port=PORT, from_page=from_page)
    return int(refusal.status) if refusal else 0


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8080", "localhost:8080", "LOCALHOST", "[::1]:8080", "localhost:9000"]
)
def test_this_machine_s_names_are_answered(host):
    assert not refused(Access(), host=host)
    assert not refused(Access(), host=host, origin=f"http://{host}", from_page=True)


@pytest.mark.parametrize(
    "host",
    ["evil.example:8080", "127.0.0.1.evil.example", "evil.example", "", None, "localhost.evil.example:8080"],
)
def test_a_name_that_was_pointed_at_this_machine_is_not(host):
    assert refused(Access(), host=host) == 403


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "null",
        "",
        "http://127.0.0.1:9999",
        "http://localhost:8080",
        "http://127.0.0.1:8080.evil.example",
        "file://127.0.0.1:8080",
        "http://user@127.0.0.1:8080",
        "http://[",
    ],
)
def test_another_page_is_not_answered(origin):
    assert refused(Access(), origin=origin) == 403
    assert refused(Access(), origin=origin, from_page=True) == 403


def test_what_only_a_page_asks_for_needs_its_origin():
    assert refused(Access(), from_page=True) == 403
    assert not refused(Access(), origin="http://127.0.0.1:8080", from_page=True)


def test_elsewhere_the_token_is_needed_once_and_then_its_cookie():
    cookie = ELSEWHERE.cookie(PORT).partition(";")[0]
    assert refused(ELSEWHERE, host="192.0.2.7:8080") == 401
    assert not refused(ELSEWHERE, host="192.0.2.7:8080", path="/?token=secret")
    assert not refused(ELSEWHERE, host="192.0.2.7:8080", cookie=f"other=1; {cookie}")
    for attribute in ("HttpOnly", "SameSite=Strict"):
        assert attribute in ELSEWHERE.cookie(PORT)


@pytest.mark.parametrize(
    ("path", "cookie"),
    [
        ("/?token=", None),
        ("/?token=secre", None),
        ("/?token=secrett", None),
        ("/?token=SECRET", None),
        ("/?TOKEN=secret", None),
        ("/?token=%ff%fe", None),
        ("/?token=wrong&token=secret", None),
        ("/#token=secret", None),
        ("/?" + "&".join(f"a{n}=1" for n in range(99)) + "&token=secret", None),
        ("/", "tracking3d_8080=wrong"),
        ("/", "tracking3d_8081=secret"),
        ("/", "tracking3d_8080"),
        ("/", "\x00=;;=="),
    ],
)
def test_a_wrong_token_is_none(path, cookie):
    assert refused(ELSEWHERE, path=path, cookie=cookie) == 401


def test_the_token_does_not_help_another_page():
    assert refused(ELSEWHERE, path="/?token=secret", origin="http://evil.example") == 403


def test_long_headers_are_not_looked_at():
    assert refused(Access(), cookie="a" * 100_000) == 431
    assert refused(ELSEWHERE, path="/?token=" + "a" * 100_000) == 431


def test_only_a_host_that_others_reach_has_a_token_and_each_its_own():
    assert Access.on(None).address(80) == "http://127.0.0.1:80/"
    first, second = Access.on("0.0.0.0"), Access.on("0.0.0.0")
    assert first.token != second.token and len(first.token) >= 32
    assert first.address(80).endswith(first.token)
    assert first.token not in repr(first)
    assert Access.on("::1").address(80).startswith("http://[::1]:80/")


@pytest.mark.parametrize("host", ["", "no such name", "192.0.2.1", "a" * 300, "::zz", "12.34"])
def test_a_host_that_is_not_this_machine_is_refused_at_once(host):
    with pytest.raises(InputError, match="is not an address of this machine"):
        Access.on(host)
