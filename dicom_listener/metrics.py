"""Counters and latencies of one listener, in a registry of its own."""

from collections.abc import Callable

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, start_http_server

_LATENCY_BUCKETS_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0, 30.0)


class ListenerMetrics:
    """What `/metrics` shows. Labels are codes of ours, never values from the network."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.stored = self._counter("slices_stored", "C-STORE requests answered Success")
        self.stored_bytes = self._counter("stored_bytes", "Data set bytes made durable")
        self.refused = self._counter("slices_refused", "C-STORE requests refused", "status")
        self.echoes = self._counter("echoes", "C-ECHO requests answered")
        self.commitments = self._counter("commitments", "Storage commitments requested", "status")
        self.associations = self._counter("associations", "Associations by outcome", "outcome")
        self.endings = self._counter("association_endings", "Associations by ending", "ending")
        self.dropped = self._counter("connections_dropped", "Connections without an association")
        self.decided = self._counter("slices_decided", "Frames by decision", "state", "reason")
        self.duplicates = self._counter("duplicates", "Instances received again, same bytes")
        self.alarms = self._counter("alarms", "Alarms by kind", "kind")
        self.store_seconds = Histogram(
            "autospine_listener_store_seconds",
            "From the first byte of a C-STORE request to its answer",
            buckets=_LATENCY_BUCKETS_S,
            registry=self.registry,
        )
        self.intake_seconds = Histogram(
            "autospine_listener_intake_seconds",
            "From the answer Success to the row in the case record",
            buckets=_LATENCY_BUCKETS_S,
            registry=self.registry,
        )

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(f"autospine_listener_{name}", text, labels, registry=self.registry)

    def show(self, name: str, text: str, read: Callable[[], float]) -> None:
        """Add a gauge whose value is read when somebody looks."""
        gauge = Gauge(f"autospine_listener_{name}", text, registry=self.registry)
        gauge.set_function(read)

    def serve(self, port: int) -> tuple[int, Callable[[], None]]:
        """Serve `/metrics` on localhost; return the port bound and what stops it."""
        server, thread = start_http_server(port, addr="127.0.0.1", registry=self.registry)

        def stop() -> None:
            server.shutdown()
            server.server_close()
            thread.join()

        return server.server_port, stop
