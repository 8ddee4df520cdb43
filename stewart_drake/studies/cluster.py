"""A Dask cluster as the place where joblib runs its jobs."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager
from typing import Any, Final

import joblib

from stewart_drake.files.errors import ConfigError

_CONNECT_TIMEOUT: Final = 10.0
"""s to wait for a scheduler."""
_KEPT: Final = "what had finished is kept and the same command goes on from there"


@contextmanager
def dask_backend(scheduler: str) -> Iterator[None]:
    """Make a Dask cluster the backend of joblib.

    Args:
        scheduler: its address, such as tcp://127.0.0.1:8786.

    Raises:
        ConfigError: no scheduler there; no workers, or workers that cannot be used.
        ChildProcessError: in the context, workers died over one job, or the scheduler went away.
    """
    try:
        from distributed import Client, KilledWorker
    except ImportError:
        raise ConfigError(
            "--scheduler: needs the package distributed; install it with pip install distributed"
        ) from None
    connect: Any = Client  # which has no annotations
    try:
        client = connect(scheduler, timeout=_CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"--scheduler: got {scheduler!r}; expected the address of a running Dask scheduler, "
            f"such as tcp://127.0.0.1:8786 ({reason})"
        ) from None
    with client:
        _check_workers(scheduler, client.nthreads())
        joblib.register_parallel_backend("stewart-drake-dask", _backend_class())
        try:
            with joblib.parallel_config(backend="stewart-drake-dask", client=client):
                yield
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


def _check_workers(scheduler: str, threads: Mapping[str, int]) -> None:
    if not threads:
        raise ConfigError(f"--scheduler: {scheduler} has no workers; start at least one first")
    # The compiled equations of motion hold their arguments in buffers, one set to a process.
    if max(threads.values()) > 1:
        raise ConfigError(
            f"--scheduler: a worker of {scheduler} has {max(threads.values())} threads; expected "
            "workers with one thread each (dask worker --nthreads 1)"
        )


def _backend_class() -> type:
    from joblib._dask import DaskDistributedBackend

    class Backend(DaskDistributedBackend):  # type: ignore[misc]
        """joblib's own, but for two things.

        It calls back for results only and would wait for ever for a job that Dask has given up; and
        what has one worker joblib does not use at all, it runs the jobs in this process.
        """

        def effective_n_jobs(self, n_jobs: int) -> int:
            return max(2, int(super().effective_n_jobs(n_jobs)))

        def submit(
            self, func: Callable[[], Any], callback: Callable[[Any], None] | None = None
        ) -> Any:
            future = super().submit(func, callback)

            def tell(done: Future[Any]) -> None:
                error = done.exception()
                if error is not None and callback is not None:
                    callback(error)

            future.add_done_callback(tell)
            return future

        def retrieve_result_callback(self, out: Any) -> Any:
            # A lost scheduler leaves its CancelledError as the result of every job.
            if isinstance(out, BaseException):
                raise out
            return super().retrieve_result_callback(out)

    return Backend
