"""The server of `view`: what it gives, and what it refuses."""

from __future__ import annotations

import gzip
import re
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.viewer import server as module
from flexgs_edge.viewer.server import Resource, SceneServer

BODY = bytes(range(256)) * 600


@pytest.fixture
def server(tmp_path: Path) -> Iterator[SceneServer]:
    (tmp_path / "scene.fgs").write_bytes(BODY)
    (tmp_path / "secret.txt").write_bytes(b"not for you")
    made = SceneServer(
        {
            "viewer/index.html": Resource("text/html; charset=utf-8", b"<p>page</p>", gzip.compress(b"<p>page</p>")),
            "viewer/scene.fgs": Resource("application/octet-stream", tmp_path / "scene.fgs"),
        }
    )
    thread = threading.Thread(target=made.serve)
    thread.start()
    yield made
    made.stop()
    thread.join(10)
    assert not thread.is_alive()


def connect(server: SceneServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=10)


def raw(server: SceneServer, data: bytes) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of the answer to these bytes."""
    with connect(server) as line:
        line.sendall(data)
        answer = b"".join(iter(lambda: line.recv(1 << 16), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    first, *rest = head.decode().split("\r\n")
    return int(first.split()[1]), dict(row.split(": ", 1) for row in rest), body


def ask(
    server: SceneServer, path: str, method: str = "GET", host: str | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    where = f"127.0.0.1:{server.port}" if host is None else host
    lines = [f"{method} {path} HTTP/1.1", f"Host: {where}", *(f"{k}: {v}" for k, v in headers.items()), "", ""]
    return raw(server, "\r\n".join(lines).encode())


def path_of(server: SceneServer, name: str) -> str:
    return f"/{server.secret}/{name}"


def test_what_is_there_is_given_with_strict_headers(server: SceneServer) -> None:
    status, headers, body = ask(server, path_of(server, "viewer/index.html"))
    assert (status, body) == (200, b"<p>page</p>")
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "unsafe" not in headers["Content-Security-Policy"] and "http" not in headers["Content-Security-Policy"]
    assert "Access-Control-Allow-Origin" not in headers and "Server" not in headers
    status, headers, body = ask(server, path_of(server, "viewer/scene.fgs") + "?x=1", "HEAD")
    assert (status, headers["Content-Length"], body) == (200, str(len(BODY)), b"")
    assert ask(server, path_of(server, "viewer/scene.fgs"))[2] == BODY


def test_texts_are_packed_for_those_who_take_it(server: SceneServer) -> None:
    path = path_of(server, "viewer/index.html")
    _, headers, body = ask(server, path, **{"Accept-Encoding": "br, gzip"})
    assert headers["Content-Encoding"] == "gzip" and gzip.decompress(body) == b"<p>page</p>"
    assert "Content-Encoding" not in ask(server, path, **{"Accept-Encoding": "br"})[1]
    _, headers, body = ask(server, path_of(server, "viewer/scene.fgs"), **{"Accept-Encoding": "gzip"})
    assert "Content-Encoding" not in headers and body == BODY
    assert ask(server, path, **{"Accept-Encoding": "gzip", "Range": "bytes=0-2"})[::2] == (206, b"<p>")


@pytest.mark.parametrize(
    ("asked", "part"),
    [
        ("bytes=0-0", slice(0, 1)),
        ("bytes=10-99", slice(10, 100)),
        ("bytes=150000-", slice(150000, None)),
        ("bytes=-7", slice(-7, None)),
        ("bytes=0-999999999", slice(0, None)),
        ("bytes=-999999999", slice(0, None)),
    ],
)
def test_a_range(server: SceneServer, asked: str, part: slice) -> None:
    status, headers, body = ask(server, path_of(server, "viewer/scene.fgs"), Range=asked)
    start, stop, _ = part.indices(len(BODY))
    assert (status, body) == (206, BODY[part])
    assert headers["Content-Range"] == f"bytes {start}-{stop - 1}/{len(BODY)}"


@pytest.mark.parametrize("asked", ["bytes=999999999-", "bytes=9-3", "bytes=-0"])
def test_a_range_that_is_not_there(server: SceneServer, asked: str) -> None:
    status, headers, _ = ask(server, path_of(server, "viewer/scene.fgs"), Range=asked)
    assert (status, headers["Content-Range"]) == (416, f"bytes */{len(BODY)}")


@pytest.mark.parametrize("asked", ["bytes=0-1,5-6", "lines=1-2", "bytes=-", "bytes=a-b", "bytes=" + "9" * 400 + "-"])
def test_ranges_that_are_not_understood_are_answered_with_the_whole(server: SceneServer, asked: str) -> None:
    assert ask(server, path_of(server, "viewer/scene.fgs"), Range=asked)[0] == 200


@pytest.mark.parametrize(
    "name",
    [
        "",
        "viewer",
        "viewer/",
        "viewer/secret.txt",
        "viewer/../viewer/index.html",
        "../secret.txt",
        "..%2fsecret.txt",
        "%2e%2e/secret.txt",
        "viewer/..\\secret.txt",
        "viewer//index.html",
        "viewer/index.html%00",
        "/etc/passwd",
        "viewer/scene.fgs/..",
    ],
)
def test_nothing_else_is_there(server: SceneServer, name: str) -> None:
    assert ask(server, path_of(server, name))[0] == 404


@pytest.mark.parametrize(
    "path", ["/", "/viewer/index.html", "/../../etc/passwd", "//viewer/index.html", "/x/viewer/index.html"]
)
def test_without_the_random_part_nothing_is_there(server: SceneServer, path: str) -> None:
    assert ask(server, path)[0] == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "127.0.0.1.evil:{port}", ""]
)
def test_other_hosts_are_refused(server: SceneServer, host: str) -> None:
    """Whatever name leads here, the browser says it: a page of that name shall not read the scene."""
    path = path_of(server, "viewer/index.html")
    assert ask(server, path, host=host.format(port=server.port))[0] == 421
    assert ask(server, path, host=f"LOCALHOST:{server.port}")[0] == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "PROPFIND"])
def test_other_methods_are_refused(server: SceneServer, method: str) -> None:
    status, headers, _ = ask(server, path_of(server, "viewer/index.html"), method)
    assert (status, headers["Allow"]) == (405, "GET, HEAD")


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"GET\r\n\r\n", 400),
        (b"GET / HTTP/2.0\r\nHost: x\r\n\r\n", 505),
        (b"\x16\x03\x01\x02\x00\x01\r\n\r\n", 400),
        (b"get / HTTP/1.1\r\nHost: {host}\r\n\r\n", 405),
        (b"GET / HTTP/1.1\r\nno colon\r\n\r\n", 421),
        (b"GET / HTTP/1.1\r\nHost: {host}\r\nHost: {host}\r\n\r\n", 421),
        (b"GET / HTTP/1.1\r\nHost : {host}\r\n\r\n", 421),
        (b"GET / HTTP/1.1\r\n folded: a\r\n\r\n", 421),
    ],
)
def test_what_is_no_request_is_refused(server: SceneServer, data: bytes, status: int) -> None:
    assert raw(server, data.replace(b"{host}", f"127.0.0.1:{server.port}".encode()))[0] == status


def test_a_silent_client_is_left_and_holds_nobody_up(server: SceneServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module._Handler, "timeout", 0.5)
    with connect(server) as silent:
        silent.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1")
        assert ask(server, path_of(server, "viewer/index.html"))[0] == 200
        assert silent.recv(4096) == b""


def test_a_body_is_refused(server: SceneServer) -> None:
    path = path_of(server, "viewer/index.html")
    assert ask(server, path, **{"Content-Length": "5"})[0] == 400
    assert ask(server, path, **{"Transfer-Encoding": "chunked"})[0] == 400


def test_oversized_headers_are_refused(server: SceneServer) -> None:
    line = f"GET {path_of(server, 'viewer/index.html')} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n".encode()
    assert raw(server, line + b"X: " + b"a" * 70000 + b"\r\n\r\n")[0] == 431
    assert raw(server, line + b"X: a\r\n" * 200 + b"\r\n")[0] == 431


def test_secrets_differ(server: SceneServer) -> None:
    other = SceneServer({}, port=0)
    assert other.secret != server.secret and re.fullmatch(r"[\w-]{16}", other.secret)
    with pytest.raises(InputError, match=r"--port"):
        SceneServer({}, port=server.port)
    with pytest.raises(InputError, match=r"cannot listen at no\.such\.host\.invalid"):
        SceneServer({}, host="no.such.host.invalid")
    other._server.server_close()


def test_hosts_of_a_server_for_other_machines() -> None:
    made = SceneServer({}, host="0.0.0.0")
    try:
        for host, known in (("192.168.1.5", True), ("evil.example", False), ("localhost", True), ("[::1]", True)):
            assert made.knows(f"{host}:{made.port}") is known
        assert made.address("a").startswith(f"http://127.0.0.1:{made.port}/")
    finally:
        made._server.server_close()
