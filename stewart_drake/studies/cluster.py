"""Calls on the workers of a Dask cluster."""

import asyncio
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Final, TypeVar

from stewart_drake.files.errors import ConfigError

_CONNECT_TIMEOUT: Final = 10.0
"""Longest wait for the scheduler, and for its first worker, s."""
_KEPT: Final = "what had finished is kept and the same command goes on from there"
_T = TypeVar("_T")


# joblib's backend for Dask waits for ever where workers die over a call, so futures are used here.
def on_cluster(scheduler: str, calls: Sequence[Callable[[], _T]]) -> Generator[_T]:
    """Yield what calls return, as they finish; closing the iterator cancels the others.

    Args:
        scheduler: its address, such as tcp://127.0.0.1:8786.
        calls: of functions that its workers can import.

    Raises:
        ConfigError: no scheduler there; no workers, or workers that cannot be used.
        ChildProcessError: workers died over one call, or the scheduler went away.
    """
    try:
        import distributed
    except ImportError:
        raise ConfigError(
            "--scheduler: needs the package distributed; install it with pip install distributed"
        ) from None
    dask: Any = distributed  # without types
    try:
        _find(dask, scheduler)
        client = dask.Client(scheduler, timeout=_CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # the last where TLS is not configured
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"--scheduler: got {scheduler!r}; expected the address of a running Dask scheduler, "
            f"such as tcp://127.0.0.1:8786 ({reason})"
        ) from None
    with client:
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=_CONNECT_TIMEOUT)
        threads = max(client.nthreads().values(), default=0)
        if threads == 0:
            raise ConfigError(f"--scheduler: {scheduler} has no workers; start at least one first")
        # The compiled equations of motion have one set of buffers per process.
        if threads > 1:
            raise ConfigError(
                f"--scheduler: a worker of {scheduler} has {threads} threads; expected workers "
                "with one thread each (dask worker --nthreads 1)"
            )
        futures = [client.submit(call, pure=False) for call in calls]
        try:
            for future in dask.as_completed(futures, loop=client.loop):
                yield future.result()
        except dask.KilledWorker:
            raise ChildProcessError(
                f"Dask gave up a job whose workers died one after the other; {_KEPT}"
            ) from None
        except dask.CancelledError:
            raise ChildProcessError(f"the scheduler {scheduler} went away; {_KEPT}") from None
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"--scheduler: the workers of {scheduler} lack a module ({error}); install the "
                "same stewart-drake there"
            ) from None


def _find(dask: Any, scheduler: str) -> None:
    """Connect once without a client: one that finds no scheduler leaves an event loop running.

    Raises:
        OSError, ValueError: no scheduler there, or not an address.
    """
    options = dask.Security().get_connection_args("client")

    async def greet() -> None:
        await (await dask.comm.connect(scheduler, timeout=_CONNECT_TIMEOUT, **options)).close()

    # The thread that calls may have an event loop already, as in a notebook.
    with ThreadPoolExecutor(1) as thread:
        thread.submit(asyncio.run, greet()).result()
