"""Serve one scene and its viewer on this machine.

Only what stands in a table of paths exists: no folder is mapped, so no path leads out of it. The first part of every path is
random, and the `Host` of a request has to be ours: other pages in the browser can neither guess the address nor reach it under
a name of their own.
"""

from __future__ import annotations

import http.server
import io
import ipaddress
import os
import re
import secrets
import socket
import socketserver
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

from flexgs_edge.errors import InputError

IDLE_SECONDS = 30.0  # A connection on which nothing moves for so long is closed
_PIECE = 1 << 16
_RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")
_NOTHING = "default-src 'none'; frame-ancestors 'none'"
_HEADERS = {
    "Content-Security-Policy": _NOTHING,
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Connection": "close",
}


@dataclass(frozen=True)
class Resource:
    """What lies at a path: bytes, or a file that is read when it is asked for."""

    kind: str  # content type
    content: bytes | Path
    # The content packed with gzip, for those who take it. A scene has none: it is packed already.
    packed: bytes | None = None
    policy: str | None = None  # What a page may load and run. Default: nothing.


class SceneServer:
    """A server of a fixed set of resources.

    `resources`: resources by their path, without a leading slash. `host`: address to listen at. `port`: 0 for any that
    is free. Raises `InputError` if the address cannot be used.
    """

    def __init__(self, resources: Mapping[str, Resource], host: str = "127.0.0.1", port: int = 0) -> None:
        self.secret = secrets.token_urlsafe(12)
        self.host = host
        self._table = {f"/{self.secret}/{path}": resource for path, resource in resources.items()}
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._server = _Server(host, port, family, self)
        except (OSError, UnicodeError) as error:
            raise InputError(
                f"cannot listen at {host}, port {port}: {error}; choose others with --host and --port"
            ) from None
        self.port = int(self._server.server_address[1])

    def address(self, path: str) -> str:
        """The address of a resource, as this machine reaches it."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host)
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{self.port}/{self.secret}/{path}"

    def serve(self) -> None:
        """Answer requests until `stop`, or an interrupt."""
        with self._server:
            self._server.serve_forever(poll_interval=0.2)

    def stop(self) -> None:
        """End `serve`, which runs in another thread."""
        self._server.shutdown()

    def find(self, path: str) -> Resource | None:
        """What lies at the path of a request."""
        return self._table.get(path)

    def knows(self, host: str) -> bool:
        """Whether the `Host` of a request is this server. Names of other pages that lead here are not."""
        name, _, port = host.lower().rpartition(":") if re.search(r":\d+$", host) else (host.lower(), "", "80")
        if port != str(self.port):
            return False
        if name in ("127.0.0.1", "localhost", self.host.lower()):
            return True
        if self.host in ("127.0.0.1", "localhost", "::1"):
            return name == "[::1]"
        try:  # listening for other machines: they come by address, which no other page can claim
            ipaddress.ip_address(name.strip("[]"))
        except ValueError:
            return False
        return True


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, host: str, port: int, family: int, owner: SceneServer) -> None:
        self.address_family = family
        self.owner = owner
        super().__init__((host, port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no fault of ours."""


class _Refused(Exception):
    def __init__(self, status: HTTPStatus, **headers: str) -> None:
        self.status = status
        self.headers = {name.replace("_", "-"): value for name, value in headers.items()}


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server
    timeout = IDLE_SECONDS
    protocol_version = "HTTP/1.1"

    def parse_request(self) -> bool:
        """Let in what asks for something under our own name, without a body."""
        if not super().parse_request():
            return False
        hosts = self.headers.get_all("host", [])
        if len(hosts) != 1 or not self.server.owner.knows(hosts[0].strip()):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
        elif self.command not in ("GET", "HEAD"):
            self._refuse(_Refused(HTTPStatus.METHOD_NOT_ALLOWED, Allow="GET, HEAD"))
        elif self.headers.get("content-length", "0") != "0" or "transfer-encoding" in self.headers:
            self.send_error(HTTPStatus.BAD_REQUEST)
        else:
            return True
        return False

    def do_GET(self) -> None:
        try:
            self._answer()
        except _Refused as refused:
            self._refuse(refused)

    do_HEAD = do_GET

    def _answer(self) -> None:
        resource, asked = self.server.owner.find(self.path.partition("?")[0]), self.headers.get("range")
        if resource is None:
            raise _Refused(HTTPStatus.NOT_FOUND)
        content, about = resource.content, {"Content-Type": resource.kind, "Accept-Ranges": "bytes"}
        if resource.packed is not None and asked is None and _takes_gzip(self.headers.get("accept-encoding", "")):
            content, about = resource.packed, {"Content-Type": resource.kind, "Content-Encoding": "gzip"}
        if resource.policy is not None:
            about["Content-Security-Policy"] = f"{resource.policy}; frame-ancestors 'none'"
        size = len(content) if isinstance(content, bytes) else os.stat(content).st_size
        part = _part(asked, size)
        start, stop = part or (0, size)
        status = HTTPStatus.OK
        if part is not None:
            status = HTTPStatus.PARTIAL_CONTENT
            about["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
        self._send(status, about, stop - start)
        if self.command == "HEAD":
            return
        with io.BytesIO(content) if isinstance(content, bytes) else open(content, "rb") as file:
            file.seek(start)
            while start < stop and (piece := file.read(min(_PIECE, stop - start))):
                self.wfile.write(piece)
                start += len(piece)

    def _send(self, status: HTTPStatus, about: Mapping[str, str], length: int) -> None:
        self.send_response_only(status)
        for name, value in {**_HEADERS, **about, "Content-Length": str(length)}.items():
            self.send_header(name, value)
        self.end_headers()

    def _refuse(self, refused: _Refused) -> None:
        text = f"{refused.status.value} {refused.status.phrase}\n".encode()
        self._send(refused.status, {"Content-Type": "text/plain; charset=utf-8", **refused.headers}, len(text))
        self.wfile.write(text)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer what the base class finds wrong with a request."""
        self.request_version = self.protocol_version  # the base class would answer without headers
        self._refuse(_Refused(HTTPStatus(code)))

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""


def _takes_gzip(accepted: str) -> bool:
    return any(part.strip().lower() == "gzip" for part in accepted.split(","))


def _part(asked: str | None, size: int) -> tuple[int, int] | None:
    """First and end byte of a single range; None for the whole. Several ranges are answered with the whole."""
    found = None if asked is None else _RANGE.fullmatch(asked)
    if found is None or not (found[1] or found[2]):
        return None
    if not found[1]:
        start, stop = max(size - int(found[2]), 0), size
    else:
        start, stop = int(found[1]), min(int(found[2]) + 1, size) if found[2] else size
    if start >= size or (found[1] and found[2] and int(found[2]) < start):
        raise _Refused(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, Content_Range=f"bytes */{size}")
    return start, stop


__all__ = ["Resource", "SceneServer"]
