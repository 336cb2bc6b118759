"""Serve one scene and its viewer on this machine.

Only what stands in a table of paths exists: no folder is mapped, so no path leads out of it. The first part of every path is
random, and the `Host` of a request has to be ours: other pages in the browser can neither guess the address nor reach it under
a name of their own.
"""

import ipaddress
import os
import re
import secrets
import socket
import socketserver
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Any

from flexgs_edge.errors import InputError

HEAD_MOST = 16384  # Most bytes of a request; browsers send less than one kilobyte
HEAD_SECONDS = 10.0  # Time for a request to come
SEND_SECONDS = 30.0  # Time for a piece of an answer to go
CONNECTIONS_MOST = 64
_PIECE = 1 << 16
_REQUEST = re.compile(r"([A-Z]{1,16}) (\S{1,2048}) HTTP/1\.[01]")
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
        return self._address({"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.host, self.host), path)

    def _address(self, host: str, path: str) -> str:
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/{self.secret}/{path}"

    def address_for_others(self, path: str) -> str | None:
        """The address of a resource for other machines; None if they do not reach this server."""
        if self.host in ("127.0.0.1", "localhost", "::1"):
            return None
        if self.host not in ("0.0.0.0", "::"):
            return self.address(path)
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                # Nothing is sent: it tells by which of its addresses this machine is seen.
                probe.connect(("192.0.2.1", 9))
                return self._address(probe.getsockname()[0], path)
        except OSError:  # no network
            return self.address(path)

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
    request_queue_size = CONNECTIONS_MOST
    daemon_threads = True

    def __init__(self, host: str, port: int, family: int, owner: SceneServer) -> None:
        self.address_family = family
        self.owner = owner
        self.free = threading.BoundedSemaphore(CONNECTIONS_MOST)
        super().__init__((host, port), _Handler)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self.free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no fault of ours."""


class _Refused(Exception):
    def __init__(self, status: HTTPStatus, **headers: str) -> None:
        self.status = status
        self.headers = headers


class _Handler(socketserver.BaseRequestHandler):
    server: _Server

    def handle(self) -> None:
        try:
            self._answer()
        except _Refused as refused:
            more = {name.replace("_", "-"): value for name, value in refused.headers.items()}
            text = f"{refused.status.value} {refused.status.phrase}\n".encode()
            self._send(refused.status, {"Content-Type": "text/plain; charset=utf-8", **more}, text)
            self._drain()
        except OSError:
            pass

    def _answer(self) -> None:
        method, path, headers = self._request()
        owner = self.server.owner
        if not owner.knows(headers.get("host", "")):
            raise _Refused(HTTPStatus.MISDIRECTED_REQUEST)
        if method not in ("GET", "HEAD"):
            raise _Refused(HTTPStatus.METHOD_NOT_ALLOWED, Allow="GET, HEAD")
        if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
            raise _Refused(HTTPStatus.BAD_REQUEST)
        resource = owner.find(path)
        if resource is None:
            raise _Refused(HTTPStatus.NOT_FOUND)
        content, about = resource.content, {"Content-Type": resource.kind, "Accept-Ranges": "bytes"}
        accepted = {word.strip().lower() for word in headers.get("accept-encoding", "").split(",")}
        if resource.packed is not None and "range" not in headers and "gzip" in accepted:
            content, about = resource.packed, {"Content-Type": resource.kind, "Content-Encoding": "gzip"}
        if resource.policy is not None:
            about["Content-Security-Policy"] = f"{resource.policy}; frame-ancestors 'none'"
        size = len(content) if isinstance(content, bytes) else os.stat(content).st_size
        part = _part(headers.get("range"), size)
        start, stop = part or (0, size)
        status = HTTPStatus.OK
        if part is not None:
            status = HTTPStatus.PARTIAL_CONTENT
            about["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
        self._send(status, about, b"", stop - start)
        if method == "HEAD":
            return
        if isinstance(content, bytes):
            self._write(content[start:stop])
            return
        with open(content, "rb") as file:
            file.seek(start)
            while start < stop and (piece := file.read(min(_PIECE, stop - start))):
                self._write(piece)
                start += len(piece)

    def _request(self) -> tuple[str, str, dict[str, str]]:
        """Method, path without its query, and headers."""
        lines = self._head().decode("latin-1").split("\r\n")
        found = _REQUEST.fullmatch(lines[0])
        if found is None:
            raise _Refused(HTTPStatus.BAD_REQUEST)
        headers: dict[str, str] = {}
        for line in lines[1:]:
            name, colon, value = line.partition(":")
            name = name.lower()
            if not colon or not name or name != name.strip() or (name in headers and name == "host"):
                raise _Refused(HTTPStatus.BAD_REQUEST)
            headers[name] = value.strip()
        return found[1], found[2].partition("?")[0], headers

    def _head(self) -> bytes:
        """The bytes of a request. They have to come within a time, however slowly each of them does."""
        until = time.monotonic() + HEAD_SECONDS
        data = b""
        while (end := data.find(b"\r\n\r\n")) < 0:
            if len(data) > HEAD_MOST:
                raise _Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE)
            self.request.settimeout(max(until - time.monotonic(), 0.001))
            try:
                piece = self.request.recv(4096)
            except TimeoutError:
                raise _Refused(HTTPStatus.REQUEST_TIMEOUT) from None
            if not piece:
                raise OSError("the client went away")
            data += piece
        return data[:end]

    def _send(self, status: HTTPStatus, about: Mapping[str, str], body: bytes, length: int | None = None) -> None:
        headers = {**_HEADERS, **about, "Content-Length": str(len(body) if length is None else length)}
        lines = [f"HTTP/1.1 {status.value} {status.phrase}", *(f"{name}: {value}" for name, value in headers.items())]
        self._write("\r\n".join([*lines, "", ""]).encode("latin-1") + body)

    def _write(self, data: bytes) -> None:
        for at in range(0, len(data), _PIECE):
            self.request.settimeout(SEND_SECONDS)
            self.request.sendall(data[at : at + _PIECE])

    def _drain(self) -> None:
        """Read what a refused client still sends, for a moment: an early close would take our answer with it."""
        try:
            self.request.shutdown(socket.SHUT_WR)
            until = time.monotonic() + 0.5
            while (left := until - time.monotonic()) > 0:
                self.request.settimeout(left)
                if not self.request.recv(_PIECE):
                    return
        except OSError:
            pass


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
