"""Who may use the page."""

import asyncio
from typing import Any

import pytest

from tcbi_dashboard.access import Access, Guard, own_hosts

LOCAL = Access.of("localhost", 8080, allow_motion=False)
OPEN = Access.of("0.0.0.0", 8080, allow_motion=False)


def answer(access: Access, path: str = "/", kind: str = "http", **headers: str) -> list[dict[str, Any]]:
    """What the guard sends for a request; `{"type": "passed"}` where it lets it through."""
    sent: list[dict[str, Any]] = []

    async def app(scope, receive, send):
        await send({"type": "passed"})

    async def receive():
        return {"type": f"{kind}.connect"}

    async def send(message):
        sent.append(message)

    place, _, query = path.partition("?")
    named = [(k.replace("_", "-").encode(), v.encode()) for k, v in {"host": "localhost:8080", **headers}.items()]
    scope = {"type": kind, "method": "GET", "path": place, "query_string": query.encode(), "headers": named}
    asyncio.run(Guard(app, access)(scope, receive, send))
    return sent


def passed(*args, **headers) -> bool:
    """Whether the guard let it through."""
    return answer(*args, **headers) == [{"type": "passed"}]


def test_localhost_needs_no_token_and_may_move_the_robot():
    assert LOCAL.token == "" and LOCAL.motion
    assert passed(LOCAL)


def test_another_address_has_a_token_and_moves_the_robot_only_if_it_was_said():
    assert len(OPEN.token) >= 32 and not OPEN.motion
    assert Access.of("0.0.0.0", 8080, allow_motion=True).motion
    assert Access.of("0.0.0.0", 8080, False).token != OPEN.token
    assert OPEN.token in OPEN.address


def test_every_address_can_be_opened_here_or_on_a_phone(monkeypatch):
    monkeypatch.setattr("tcbi_dashboard.access.own_hosts", lambda: ["192.168.1.7"])
    assert OPEN.addresses == [f"http://{host}:8080/?token={OPEN.token}" for host in ("localhost", "192.168.1.7")]
    assert OPEN.address == OPEN.addresses[0]
    assert LOCAL.addresses == ["http://localhost:8080/"]
    assert Access.of("10.0.0.5", 9000, False).address.startswith("http://10.0.0.5:9000/?token=")
    assert Access.of("fe80::2", 9000, False).address.startswith("http://[fe80::2]:9000/")


def test_this_machines_own_addresses_are_no_loopback():
    assert not [host for host in own_hosts() if host.startswith("127.") or ":" in host]


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8080", "192.168.1.7:8080", ""])
def test_a_name_that_was_pointed_at_this_machine_is_refused(host):
    assert answer(LOCAL, host=host)[0]["status"] == 421


@pytest.mark.parametrize("host", ["localhost:9000", "127.0.0.1:8080", "[::1]:8080"])
def test_every_name_of_this_machine_is_let_in_at_any_forwarded_port(host):
    assert passed(LOCAL, host=host)


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("origin", ["http://evil.example", "http://localhost:9999", "null"])
def test_a_page_of_another_origin_is_refused(kind, origin):
    sent = answer(LOCAL, kind=kind, origin=origin)
    assert sent[0].get("status") == 403 or sent[0] == {"type": "websocket.close", "code": 4403}


def test_the_pages_own_socket_is_let_in():
    assert passed(LOCAL, "/_nicegui_ws/", "websocket", origin="http://localhost:8080")


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("token", ["", "?token=wrong"])
def test_without_the_token_another_machine_gets_nothing(kind, token):
    sent = answer(OPEN, f"/{token}", kind, host="10.0.0.5:8080")
    assert sent[0].get("status") == 401 or sent[0] == {"type": "websocket.close", "code": 4403}


def test_the_token_goes_from_the_address_into_a_cookie_that_scripts_cannot_read():
    (start, _) = answer(OPEN, f"/?view=why&token={OPEN.token}", host="10.0.0.5:8080")
    headers = dict(start["headers"])
    assert start["status"] == 303 and headers[b"location"] == b"/?view=why"
    cookie = headers[b"set-cookie"].decode()
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    kept = cookie.partition(";")[0]
    assert passed(OPEN, host="10.0.0.5:8080", cookie=kept)
    assert passed(OPEN, "/_nicegui_ws/", "websocket", host="10.0.0.5:8080", cookie=kept)


def test_a_cookie_that_cannot_be_read_is_no_token():
    assert answer(OPEN, host="10.0.0.5:8080", cookie="a=[;;=\x7f")[0]["status"] == 401
