"""Which web pages may give orders, and by which names the service may be asked for.

A browser tells in `Sec-Fetch-Site` whether a request comes from the page's own origin; where it
does not tell (plain HTTP on a network, programs), `Origin` is compared with `Host` and with
`[service] public_url`, for a reverse proxy may have changed the former. The order of these tests is
that of Go's `net/http.CrossOriginProtection`. No I/O in here.
"""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit

from starlette.datastructures import Headers

_LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
_PORTS = {"http": 80, "https": 443}


@dataclass(frozen=True)
class Origin:
    """Scheme, host and port, with the port filled in; `host` empty: not a web origin."""

    scheme: str
    host: str
    port: int | None

    @classmethod
    def of(cls, url: str) -> Origin:
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError:
            return cls("", "", None)
        scheme = parts.scheme.lower()
        return cls(scheme, parts.hostname or "", port or _PORTS.get(scheme))


class OriginRules:
    """What `Host`, `Origin` and `Sec-Fetch-Site` must say.

    public_url: what people type to come to the page ("" without a proxy); needs_token: callers
    are known by their tokens, so that the name by which they ask does not matter.
    """

    def __init__(self, public_url: str, *, needs_token: bool) -> None:
        self.public_url = public_url
        self.path = urlsplit(public_url).path.rstrip("/")
        self._public = Origin.of(public_url)
        self._needs_token = needs_token

    def why_not_host(self, headers: Headers) -> str | None:
        """Why a request is not taken for the name it asks for; None if it is.

        Without tokens a foreign page whose name was made to lead here (DNS rebinding) must not be
        believed. Behind a proxy a name without a dot is the proxy's own for its upstream: the
        public DNS has no such names.
        """
        if self._needs_token:
            return None
        host = headers.get("host", "")
        name = Origin.of(f"//{host}").host
        if name in _LOOPBACK or (
            self.public_url and (name == self._public.host or "." not in name)
        ):
            return None
        return (
            f"Without tokens this service answers to loopback names only, not to {host!r}. "
            "Behind a proxy, set [service] public_url and let the proxy forward the Host header."
        )

    def why_not_origin(self, headers: Headers) -> str | None:
        """Why an order is not taken for the page it comes from; None if it is.

        A bearer token is not sent by a browser of its own accord: no foreign page can use it.
        """
        if self._needs_token and headers.get("authorization"):
            return None
        origin = headers.get("origin")
        if origin is not None and Origin.of(origin) == self._public:
            return None
        site = headers.get("sec-fetch-site")
        if site is not None:
            return None if site in ("same-origin", "none") else self._refusal(origin, headers)
        if origin is None or self._is_host(Origin.of(origin), headers.get("host", "")):
            return None
        return self._refusal(origin, headers)

    @staticmethod
    def _is_host(origin: Origin, host: str) -> bool:
        """Whether Host names the origin. A proxy may have lost the port, never invented one."""
        asked = Origin.of(f"//{host}")
        return bool(origin.host) and origin.host == asked.host and asked.port in (None, origin.port)

    def _refusal(self, origin: str | None, headers: Headers) -> str:
        own = self.public_url or headers.get("host", "")
        return (
            f"This request comes from a page at {origin or 'an unknown address'}, but this service "
            f"is at {own}. If that page is this service behind a proxy, set [service] public_url "
            "to the address shown in the browser."
        )


def is_foreign_site(headers: Headers) -> bool:
    """The browser itself says that a page of another site sends this."""
    return headers.get("sec-fetch-site") == "cross-site"


def came_over_tls(headers: Headers, scheme: str) -> bool:
    """Whether the browser's own connection is encrypted, also where a proxy ends it."""
    return scheme == "https" or headers.get("origin", "").startswith("https://")
