"""Who may use the page: this machine alone, or with `--host` those who hold the token.

Every request and every WebSocket passes `Guard`. It refuses names that are not this machine's (a web site whose name
was pointed at this machine), pages of another origin, and on another address than localhost whoever lacks the token.
"""

import hmac
import html
import secrets
import socket
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import psutil

EVERYWHERE = frozenset({"0.0.0.0", "::"})  # every address of this machine
LOCAL_NAMES = frozenset({"localhost", "127.0.0.1", "::1"})
COOKIE = "tcbi_token"
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]
HEADERS = [  # no other page may frame this one, and an address with the token goes nowhere else
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
]


@dataclass(frozen=True)
class Access:
    """The rules of one server.

    Attributes:
      token: asked for where the page is open to other machines; empty for localhost.
      motion: whether the page may make the robot move. It may always stop it.
    """

    host: str = "localhost"
    port: int = 8080
    token: str = ""
    motion: bool = True

    @staticmethod
    def of(host: str, port: int, allow_motion: bool) -> "Access":
        """Localhost may move the robot and needs no token; any other address needs one, and leave to move it."""
        if host in LOCAL_NAMES:
            return Access(host, port)
        return Access(host, port, secrets.token_urlsafe(24), allow_motion)

    @property
    def address(self) -> str:
        """What to open in a browser on this machine."""
        return self.addresses[0]

    @property
    def addresses(self) -> list[str]:
        """What to open in a browser, here or on another machine: the first one works on this machine."""
        hosts = ["localhost", *own_hosts()] if self.host in EVERYWHERE else [self.host]
        query = f"?token={self.token}" if self.token else ""
        return [f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{query}" for host in hosts]

    def refusal(self, host: str, origin: str, token: str) -> tuple[int, str] | None:
        """Why a request is refused, with the HTTP status, or None.

        Args:
          host: its Host header.
          origin: its Origin header, "" if it has none.
          token: that it brought.
        """
        if not self.token and (urlsplit(f"//{host}").hostname or "") not in LOCAL_NAMES:
            return 421, f"This page answers to localhost only, not to {host!r}. Open http://localhost:{self.port}/."
        if origin and urlsplit(origin).netloc != host:
            return 403, f"The page of another site ({origin}) may not use this one."
        if self.token and not hmac.compare_digest(token.encode(), self.token.encode()):
            return 401, "Open the address that ./tcbi dashboard printed, with the token at its end."
        return None


def own_hosts() -> list[str]:
    """IPv4 addresses of this machine under which others may reach it."""
    every = [a.address for addresses in psutil.net_if_addrs().values() for a in addresses if a.family == socket.AF_INET]
    return [host for host in every if not host.startswith("127.")]


class Guard:
    """ASGI middleware that lets through what `Access` allows, HTTP and WebSocket alike."""

    def __init__(self, app: App, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, refuse, or take the token from the address into a cookie."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        brought = query.pop("token", [""])[0]
        name = f"{COOKIE}_{self._access.port}"
        token = brought or _cookie(headers.get("cookie", ""), name)
        refused = self._access.refusal(headers.get("host", ""), headers.get("origin", ""), token)
        if refused and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 4403})
        elif refused:
            await _answer(send, refused[0], refused[1])
        elif brought and self._access.token and scope["type"] == "http" and scope["method"] == "GET":
            place = scope["path"] + (f"?{urlencode(query, doseq=True)}" if query else "")
            cookie = f"{name}={self._access.token}; HttpOnly; SameSite=Strict; Path=/"
            await _answer(send, 303, "", [(b"location", place.encode()), (b"set-cookie", cookie.encode())])
        else:
            await self._app(scope, receive, _with_headers(send))


def _cookie(text: str, name: str) -> str:
    try:
        found = SimpleCookie(text).get(name)
    except CookieError:
        return ""
    return found.value if found else ""


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", []), *HEADERS]}
        await send(message)

    return sending


def plain_page(text: str, link: bool = False) -> bytes:
    """A page of one sentence, with a link to the first page or without."""
    back = '<p><a href="/">Open the dashboard</a></p>' if link else ""
    head = "<!doctype html><meta charset=utf-8><meta name=viewport content='width=device-width'><title>tcbi</title>"
    style = "<style>body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem; color-scheme: light dark }</style>"
    return f"{head}{style}<p>{html.escape(text)}</p>{back}".encode()


async def _answer(send: Send, status: int, text: str, headers: list[tuple[bytes, bytes]] | None = None) -> None:
    body = plain_page(text)
    kind = (b"content-type", b"text/html; charset=utf-8")
    await send({"type": "http.response.start", "status": status, "headers": [kind, *HEADERS, *(headers or [])]})
    await send({"type": "http.response.body", "body": body})
