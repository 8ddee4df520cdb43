"""A Dask cluster as the place where jobs run."""

import asyncio
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from threading import Thread
from typing import Any, Final, TypeVar

from stewart_drake.files.errors import ConfigError

_CONNECT_TIMEOUT: Final = 10.0
"""s to wait for a scheduler, and for a first worker of it."""
_KEPT: Final = "what had finished is kept and the same command goes on from there"
_T = TypeVar("_T")


def on_cluster(scheduler: str, calls: Sequence[Callable[[], _T]]) -> Generator[_T]:
    """What calls return, as they finish; closing the iterator ends those in flight.

    Args:
        scheduler: its address, such as tcp://127.0.0.1:8786.
        calls: of functions that its workers can import.

    Raises:
        ConfigError: no scheduler there; no workers, or workers that cannot be used.
        ChildProcessError: workers died over one call, or the scheduler went away.
    """
    try:
        from distributed import CancelledError, Client, KilledWorker, as_completed
    except ImportError:
        raise ConfigError(
            "--scheduler: needs the package distributed; install it with pip install distributed"
        ) from None
    untyped: Any = (Client, as_completed)
    connect, in_turn = untyped
    try:
        _find(scheduler)
        client = connect(scheduler, timeout=_CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # the last where TLS is not configured
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"--scheduler: got {scheduler!r}; expected the address of a running Dask scheduler, "
            f"such as tcp://127.0.0.1:8786 ({reason})"
        ) from None
    with client:
        with suppress(TimeoutError):
            client.wait_for_workers(1, timeout=_CONNECT_TIMEOUT)
        _check_workers(scheduler, client.nthreads())
        futures = [client.submit(call, pure=False) for call in calls]
        try:
            for future in in_turn(futures, loop=client.loop):
                yield future.result()
        except KilledWorker:
            raise ChildProcessError(
                f"Dask gave up a job whose workers died one after the other; {_KEPT}"
            ) from None
        except CancelledError:
            raise ChildProcessError(f"the scheduler {scheduler} went away; {_KEPT}") from None
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"--scheduler: the workers of {scheduler} lack a module ({error}); install the "
                "same stewart-drake there"
            ) from None


# A client that finds nobody leaves a running event loop behind, and is closed by whatever thread
# happens to collect garbage; where that is the loop of the next client, both wait for each other.
def _find(scheduler: str) -> None:
    """Connect once, before there is a client.

    Raises:
        OSError: nobody is there.
        ValueError: it is no address.
    """
    told = Future[None]()

    def find() -> None:
        try:
            told.set_result(asyncio.run(_greet(scheduler)))
        except BaseException as error:
            told.set_exception(error)  # raised below

    # This thread may have an event loop already, as in a notebook, and Ctrl-C has to end its wait.
    thread = Thread(target=find, daemon=True)
    thread.start()
    thread.join()
    told.result()


async def _greet(scheduler: str) -> None:
    from distributed import Security
    from distributed.comm.core import connect

    untyped: Any = (Security, connect)
    security, reach = untyped
    options = security().get_connection_args("client")
    comm = await reach(scheduler, timeout=_CONNECT_TIMEOUT, **options)
    await comm.close()


def _check_workers(scheduler: str, threads: Mapping[str, int]) -> None:
    if not threads:
        raise ConfigError(f"--scheduler: {scheduler} has no workers; start at least one first")
    # The compiled equations of motion hold their arguments in buffers, one set to a process.
    if max(threads.values()) > 1:
        raise ConfigError(
            f"--scheduler: a worker of {scheduler} has {max(threads.values())} threads; expected "
            "workers with one thread each (dask worker --nthreads 1)"
        )
