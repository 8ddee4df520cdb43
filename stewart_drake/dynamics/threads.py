"""What the threads of a process have to agree on."""

import threading
from typing import Final

from threadpoolctl import OpenBLASController, threadpool_limits


class _OneBlasThread:
    """A context in which linear algebra runs on one thread, until the last one in it leaves.

    The limit belongs to the process. Were it each run's own, the first to end would give the others
    their threads back, and the last would put back the limit that it had found.
    """

    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0
        self._limit: threadpool_limits | None = None

    def __enter__(self) -> None:
        with self._lock:
            if self._limit is None:
                self._limit = threadpool_limits(limits=1, user_api="blas")
                _leave_control()
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._limit is not None:
                self._limit.restore_original_limits()
                self._limit = None
                _leave_control()


def _leave_control() -> None:
    """From threadpoolctl 3.8 on, only the thread that has set a limit may change it, till then."""
    leave = getattr(OpenBLASController, "clear_controlling_thread", None)
    if leave is not None:
        leave()


one_blas_thread: Final = _OneBlasThread()
