"""The server of `view`: what it gives, and what it refuses."""

from __future__ import annotations

import gzip
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
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


def until(condition: Callable[[], bool]) -> None:
    for _ in range(400):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it took more than 20 s")


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
    "data",
    [
        b"\r\n\r\n",
        b"GET\r\n\r\n",
        b"get / HTTP/1.1\r\nHost: x\r\n\r\n",
        b"GET / HTTP/2.0\r\nHost: x\r\n\r\n",
        b"GET / HTTP/1.1\r\nno colon\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost : a\r\n\r\n",
        b"GET / HTTP/1.1\r\n folded: a\r\n\r\n",
        b"GET /" + b"a" * 5000 + b" HTTP/1.1\r\nHost: x\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\r\n\r\n",
    ],
)
def test_what_is_no_request_is_refused(server: SceneServer, data: bytes) -> None:
    assert raw(server, data)[0] == 400


def test_a_body_is_refused(server: SceneServer) -> None:
    path = path_of(server, "viewer/index.html")
    assert ask(server, path, **{"Content-Length": "5"})[0] == 400
    assert ask(server, path, **{"Transfer-Encoding": "chunked"})[0] == 400


def test_oversized_headers_are_refused(server: SceneServer) -> None:
    line = f"GET {path_of(server, 'viewer/index.html')} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n".encode()
    assert raw(server, line + b"X: " + b"a" * 40000 + b"\r\n\r\n")[0] == 431
    assert raw(server, line + b"X: a\r\n" * 5000 + b"\r\n")[0] == 431


def test_a_slow_client_is_refused_and_holds_nobody_up(server: SceneServer, monkeypatch: pytest.MonkeyPatch) -> None:
    """A byte now and then does not keep a connection open."""
    monkeypatch.setattr(module, "HEAD_SECONDS", 0.5)
    with connect(server) as slow:
        started = time.monotonic()
        answer = b""
        for byte in b"GET / HTTP/1.1\r\nHost: 127.0.0.1" * 10:
            try:
                slow.sendall(bytes([byte]))
            except OSError:
                break
            assert ask(server, path_of(server, "viewer/index.html"))[0] == 200
            slow.settimeout(0.05)
            try:
                answer += slow.recv(4096)
            except TimeoutError:
                continue
            break
        assert answer.startswith(b"HTTP/1.1 408 ") and time.monotonic() - started < 5


def test_a_client_that_does_not_read_is_left(
    server: SceneServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SEND_SECONDS", 0.3)
    (tmp_path / "scene.fgs").write_bytes(bytes(20_000_000))
    with connect(server) as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.sendall(
            f"GET {path_of(server, 'viewer/scene.fgs')} HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\n\r\n".encode()
        )
        until(lambda: server._server.free._value == module.CONNECTIONS_MOST - 1)
        until(lambda: server._server.free._value == module.CONNECTIONS_MOST)


def test_no_more_than_so_many_connections(server: SceneServer) -> None:
    free = server._server.free
    with ExitStack() as stack:
        for _ in range(module.CONNECTIONS_MOST):
            stack.enter_context(connect(server))
        until(lambda: free._value == 0)
        more = stack.enter_context(connect(server))
        assert more.recv(10) == b""
    until(lambda: free._value == module.CONNECTIONS_MOST)
    assert ask(server, path_of(server, "viewer/index.html"))[0] == 200


def test_secrets_differ(server: SceneServer) -> None:
    other = SceneServer({}, port=0)
    assert other.secret != server.secret and re.fullmatch(r"[\w-]{16}", other.secret)
    with pytest.raises(InputError, match=r"--port"):
        SceneServer({}, port=server.port)
    with pytest.raises(InputError, match=r"cannot listen at no\.such\.host\.invalid"):
        SceneServer({}, host="no.such.host.invalid")
    other._server.server_close()


def test_a_server_for_this_machine_has_no_address_for_others(server: SceneServer) -> None:
    assert server.address_for_others("a") is None


def test_hosts_of_a_server_for_other_machines() -> None:
    made = SceneServer({}, host="0.0.0.0")
    try:
        for host, known in (("192.168.1.5", True), ("evil.example", False), ("localhost", True), ("[::1]", True)):
            assert made.knows(f"{host}:{made.port}") is known
        assert made.address("a").startswith(f"http://127.0.0.1:{made.port}/")
        others = made.address_for_others("a")
        assert others is not None and re.fullmatch(rf"http://[0-9.]+:{made.port}/{made.secret}/a", others)
    finally:
        made._server.server_close()
