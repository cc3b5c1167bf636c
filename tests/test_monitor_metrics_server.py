"""/metrics and /healthz over real HTTP, for good clients beside bad ones."""

import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from http.client import HTTPConnection

import pytest
from loopback import free_port, until

from adapters.errors import UsageError
from monitor.service import metrics_server as module
from monitor.service.health import Health, ProcessHealth, VehicleHealth
from monitor.service.metrics_server import MetricsServer

WELL = Health(ProcessHealth(), (VehicleHealth("copter-1", "monitoring"),))


@contextmanager
def serving(snapshot: Callable[[], Health] = lambda: WELL) -> Iterator[MetricsServer]:
    with closing(MetricsServer("127.0.0.1:0", snapshot)) as server:
        yield server


def get(server: MetricsServer, path: str, method: str = "GET", **headers: str) -> tuple[int, str, bytes]:
    with closing(HTTPConnection("127.0.0.1", server.port, timeout=20)) as connection:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers["Content-Type"], answer.read()


def test_metrics_are_text_that_prometheus_reads() -> None:
    with serving() as server:
        status, content_type, body = get(server, "/metrics?x=1")
        assert status == 200
        assert content_type.startswith("text/plain; version=")
        assert b'fauio_vehicle_state{state="monitoring",vehicle="copter-1"} 1.0\n' in body
        assert get(server, "/metrics", Accept="application/openmetrics-text; version=1.0.0")[2].endswith(b"# EOF\n")


def test_health_is_200_while_all_is_well_and_503_with_the_reason_otherwise() -> None:
    present = [WELL]
    with serving(lambda: present[0]) as server:
        status, content_type, body = get(server, "/healthz")
        assert (status, content_type) == (200, "application/json")
        assert json.loads(body)["status"] == "ok"
        present[0] = Health(ProcessHealth(loop_age_s=60.0))
        status, _, body = get(server, "/healthz")
        assert status == 503
        assert json.loads(body)["problems"] == ["the main loop has not run for 60 s"]
        assert get(server, "/metrics")[0] == 200


def test_a_snapshot_that_fails_is_a_problem_and_not_the_end() -> None:
    def failing() -> Health:
        raise RuntimeError("changed while it was read")

    with serving(failing) as server:
        for path in ("/healthz", "/metrics"):
            status, _, body = get(server, path)
            assert status == 503
            assert json.loads(body)["problems"] == ["no snapshot: RuntimeError: changed while it was read"]


def test_other_paths_and_methods_are_refused() -> None:
    with serving() as server:
        assert get(server, "/")[0] == 404
        assert get(server, "/../etc/passwd")[0] == 404
        assert get(server, "/metrics", "POST")[0] == 405
        status, _, body = get(server, "/healthz", "HEAD")
        assert (status, body) == (200, b"")


@pytest.mark.parametrize(
    "request_bytes",
    [b"\r\n\r\n", b"GET\r\n\r\n", b"\x16\x03\x01\x02\x00 \r\n\r\n", b"GET /metrics SMTP/1\r\n\r\n"],
)
def test_what_is_no_request_is_answered_as_such(request_bytes: bytes) -> None:
    with serving() as server, socket.create_connection(("127.0.0.1", server.port), 20) as client:
        client.sendall(request_bytes)
        assert client.recv(100).startswith(b"HTTP/1.1 400 ")


def test_a_request_without_end_and_one_that_stops_are_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "REQUEST_S", 0.3)
    with serving() as server:
        with socket.create_connection(("127.0.0.1", server.port), 20) as endless, suppress(OSError):
            while True:
                endless.sendall(b"GET /" + b"x" * 10_000)
        until(lambda: server.refused == 1)
        with socket.create_connection(("127.0.0.1", server.port), 20) as slow:
            slow.sendall(b"GET /metrics HTTP/1.1\r\n")
            with suppress(ConnectionResetError):
                assert slow.recv(100) == b""
        assert server.refused == 2
        assert get(server, "/healthz")[0] == 200


def test_a_client_that_does_not_read_its_answer_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "REQUEST_S", 0.5)
    many = Health(ProcessHealth(), tuple(VehicleHealth(f"vehicle-{number}", "stale") for number in range(5000)))
    with serving(lambda: many) as server:
        with socket.socket() as deaf:
            deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            deaf.connect(("127.0.0.1", server.port))
            deaf.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
            until(lambda: server.refused == 1)
        assert get(server, "/nothing")[0] == 404


def test_many_idle_clients_take_no_threads_and_those_beyond_the_bound_are_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "REQUEST_S", 1.0)
    with serving() as server:
        threads = threading.active_count()
        idle = [socket.create_connection(("127.0.0.1", server.port), 20) for _ in range(3 * module.MAX_CONNECTIONS)]
        until(lambda: server.refused >= 2 * module.MAX_CONNECTIONS)
        assert threading.active_count() == threads
        until(lambda: server.refused == 3 * module.MAX_CONNECTIONS)
        assert get(server, "/healthz")[0] == 200
        for client in idle:
            client.close()


@pytest.mark.parametrize("address", ["192.0.2.1:0", "9464", "127.0.0.1:", "127.0.0.1:99999", "::", "host.invalid:1"])
def test_an_address_that_cannot_be_listened_on_is_refused_in_one_line(address: str) -> None:
    with pytest.raises(UsageError, match="metrics address") as refused:
        MetricsServer(address, lambda: WELL)
    assert "\n" not in str(refused.value)


def test_a_port_in_use_is_refused_in_one_line_and_free_again_after_closing() -> None:
    address = f"127.0.0.1:{free_port()}"
    first = MetricsServer(address, lambda: WELL)
    with pytest.raises(UsageError, match=r"Address already in use"):
        MetricsServer(address, lambda: WELL)
    first.close()
    first.close()
    MetricsServer(address, lambda: WELL).close()
