# SPDX-License-Identifier: Apache-2.0
"""The queue of a Dask cluster by its address. With tls:// Dask's own settings name the certificates: docs/batch.md."""

import concurrent.futures
import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from shared.config import UserError
from zenav.batch.child_process import Outcome
from zenav.batch.cluster_extra import require_extra
from zenav.batch.engine import SAME_VERSION, BatchTask, ClusterLostError, OtherCodeError, WorkQueue, run_in_child

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_S = 10.0  # until a scheduler must have answered
RETURN_S = 120.0  # until a scheduler that was lost must be back, with a worker
LOOK_S = 1.0  # between two looks for it
COUNT_S = 5.0  # between two counts of the workers


class _ClusterQueue:
    def __init__(self, task: BatchTask, client: "Client", address: str) -> None:
        from distributed import as_completed

        self._n_threads, self._counted = 0, -COUNT_S
        self._task, self._client, self._address = task, client, address
        self._finished = as_completed(loop=client.loop)
        self._numbers: dict[Future, int] = {}

    def n_threads(self) -> int:
        """As of the last COUNT_S: workers come and go."""
        if time.monotonic() - self._counted >= COUNT_S:
            with _lost_with_its_scheduler():
                self._n_threads = sum(self._client.nthreads().values())
            self._counted = time.monotonic()
        return self._n_threads

    def submit(self, number: int, item: Any) -> None:
        with _lost_with_its_scheduler():
            future = self._client.submit(run_in_child, self._task, item, pure=False)
        self._numbers[future] = number
        self._finished.add(future)

    def wait(self) -> tuple[int, Outcome]:
        future = next(self._finished)
        number, outcome = self._numbers.pop(future), self._outcome_of(future)
        future.release()
        return number, outcome

    def _outcome_of(self, future: "Future") -> Outcome:
        """The outcome of a try. A worker that died with its child is an outcome too."""
        from distributed.scheduler import KilledWorker

        if future.status == "finished":
            with _lost_with_its_scheduler():
                outcome: Outcome = future.result(timeout=CONNECT_S)
            return outcome
        with _lost_with_its_scheduler():
            error = future.exception(timeout=CONNECT_S) if future.status == "error" else None
        if isinstance(error, KilledWorker):
            return Outcome("died", detail="the cluster's worker died")
        if isinstance(error, OtherCodeError):
            raise UserError(str(error), SAME_VERSION)
        if isinstance(error, RuntimeError) and "deserialization" in str(error):  # Dask's words
            raise UserError(
                f"the scheduler or a worker of {self._address} lacks packages of this computer", SAME_VERSION
            )
        if error is not None:
            raise error
        raise ClusterLostError


@contextmanager
def _lost_with_its_scheduler() -> Iterator[None]:
    """Dask's client raises many things where its scheduler, or the worker with a result, has just gone."""
    try:
        yield
    except Exception:
        raise ClusterLostError from None


@contextmanager
def cluster_queue(task: BatchTask, address: str, is_awaited: bool) -> Iterator[WorkQueue]:
    """The queue of a cluster; is_awaited: it was there before, and may come back. Raises UserError."""
    require_extra()
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # each lost worker is reported in our words
    limit = time.monotonic() + (RETURN_S if is_awaited else 0.0)
    while True:
        try:
            client = _connected(address)
            break
        except UserError:
            if time.monotonic() > limit:
                raise
            threading.Event().wait(LOOK_S)
    try:
        yield _ClusterQueue(task, client, address)
    finally:
        with suppress(Exception):
            client.close()


def _connected(address: str) -> "Client":
    try:
        client = _made_client(address)
        n_workers = len(client.nthreads())
    except Exception as error:  # OSError, TypeError (tls:// without certificates), Dask's own for one that goes again
        hint = "start one: dask scheduler, and on each computer: dask worker ADDRESS"
        if address.startswith("tls://"):
            hint = "are Dask's certificates configured here? see docs/batch.md"
        raise UserError(f"no scheduler of Dask answers at {address}: {type(error).__name__}", hint) from None
    if not n_workers:
        client.close()
        raise UserError(f"the cluster {address} has no workers", f"on each computer: dask worker {address}")
    return client


def _made_client(address: str) -> "Client":
    """Raises TimeoutError where the scheduler says nothing after the handshake, for which Dask waits for ever.

    A client that could not connect is closed at once. Dask leaves it to the garbage collector. That may come while the
    next client starts, and then both wait for one lock.
    """
    from distributed import Client

    class ClosedClient(Client):  # type: ignore[misc]  # Dask has no types
        def __init__(self) -> None:
            try:
                super().__init__(address, timeout=CONNECT_S, set_as_default=False)
            except BaseException:
                with suppress(Exception):  # the first error says more
                    self.close()
                raise

    made: concurrent.futures.Future[Client] = concurrent.futures.Future()

    def make() -> None:
        try:
            client = ClosedClient()
        except BaseException as error:  # asyncio's CancelledError is no Exception
            with suppress(concurrent.futures.InvalidStateError):  # too late
                made.set_exception(error if isinstance(error, Exception) else ConnectionError(type(error).__name__))
            return
        try:
            made.set_result(client)
        except concurrent.futures.InvalidStateError:
            client.close()

    threading.Thread(target=make, daemon=True).start()
    try:
        return made.result(3 * CONNECT_S)
    except concurrent.futures.TimeoutError:
        made.cancel()
        raise
