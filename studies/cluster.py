"""The same work on this machine or on a Dask cluster: chunks in, results out in their order."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")

CONNECT_TIMEOUT_S = 10.0


class SchedulerError(OSError):
    """The cluster's scheduler cannot be used; the message says why, in one line."""


class Mapper(Protocol):
    """Applies a function to items; calls ``done`` once for each as it is finished."""

    def __call__(
        self, function: Callable[[T], R], items: Sequence[T], done: Callable[[], None]
    ) -> list[R]: ...


def map_here(function: Callable[[T], R], items: Sequence[T], done: Callable[[], None]) -> list[R]:
    """One item after the other, in this process."""
    return list(_each(function, items, done))


def _each(function: Callable[[T], R], items: Iterable[T], done: Callable[[], None]) -> Iterator[R]:
    for item in items:
        yield function(item)
        done()


@contextmanager
def mapper(scheduler: str | None) -> Iterator[Mapper]:
    """``map_here``, or a map on the Dask cluster whose scheduler listens at this address.

    Raises SchedulerError when it cannot be reached or has no workers.
    """
    if scheduler is None:
        yield map_here
        return
    try:
        from distributed import Client
    except ImportError as error:
        raise SchedulerError(
            "a scheduler needs the extra 'cluster': pip install autospine[cluster]"
        ) from error
    try:
        client = Client(scheduler, timeout=CONNECT_TIMEOUT_S)
    except (OSError, ValueError, TypeError) as error:
        raise SchedulerError(f"no Dask scheduler at {scheduler!r}: {error}") from error
    with client:
        if not client.scheduler_info()["workers"]:
            raise SchedulerError(f"the Dask scheduler at {scheduler!r} has no workers")
        yield _MapOn(client)


class _MapOn:
    def __init__(self, client: Any) -> None:
        self._client = client

    def __call__(
        self, function: Callable[[T], R], items: Sequence[T], done: Callable[[], None]
    ) -> list[R]:
        from distributed import as_completed

        # pure=False: a second run in the same cluster is really run, not remembered.
        futures = self._client.map(function, items, pure=False)
        for _ in as_completed(futures):
            done()
        return list(self._client.gather(futures))
