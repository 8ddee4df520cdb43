"""Copies of a process that has everything imported: to be killed, limited or given a small disk.

The process of the tests has threads, and a lock that one of them holds while it is copied would be
held in the copy for ever. The one that is copied here has a single thread.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess

import cloudpickle

PATIENCE = 180.0
"""s after which a copy that does not begin, or does not end, is taken to hang."""

_server = get_context("forkserver")
_server.set_forkserver_preload(
    [
        "hypothesis",
        "pytest",
        "h5netcdf",
        "matplotlib.pyplot",
        "stewart_drake.cli.live",
        "stewart_drake.live.session",
        "stewart_drake.live.simulated",
        "stewart_drake.reporting.csv_file",
        "stewart_drake.studies.robustness",
        "stewart_drake.tuning.data",
    ]
)


@contextmanager
def copied(work: Callable[[], object]) -> Iterator[BaseProcess]:
    """Yield a copy that has begun `work`; kill it if it has not ended.

    The copy leads a process group and says nothing; what is patched here is not patched there. Its
    exit status is what `work` returns, 0 for None, 70 where it raises.
    """
    here, there = _server.Pipe(duplex=False)
    copy = _server.Process(target=_carry_out, args=(cloudpickle.dumps(work), there))
    copy.start()
    try:
        there.close()
        with here:
            assert here.poll(PATIENCE), "the copy does not begin"
            here.recv()
        yield copy
    finally:
        kill(copy)


def _carry_out(work: bytes, begun: Connection) -> None:
    status = 70
    try:
        os.setpgid(0, 0)
        nowhere = os.open(os.devnull, os.O_RDWR)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        call = cloudpickle.loads(work)
        begun.send(None)
        result = call()
        status = result if isinstance(result, int) else 0
    finally:
        os._exit(status)


class Command:
    """`stewart-drake` in a copy, at once; with what is needed of `subprocess.Popen`.

    `stdout` has both of its streams.
    """

    def __init__(self, *arguments: str) -> None:
        here, there = _server.Pipe(duplex=False)
        self._copy = _server.Process(target=_run_command, args=(there, arguments))
        self._copy.start()
        there.close()
        self.stdout = os.fdopen(os.dup(here.fileno()), encoding="utf-8")
        here.close()

    def send_signal(self, number: int) -> None:
        assert self._copy.pid is not None
        os.kill(self._copy.pid, number)

    def kill(self) -> None:
        kill(self._copy)

    def poll(self) -> int | None:
        return self._copy.exitcode

    def wait(self, timeout: float = PATIENCE) -> int | None:
        self._copy.join(timeout)
        return self._copy.exitcode


def _run_command(out: Connection, arguments: Sequence[str]) -> None:
    from stewart_drake.cli import main

    os.setpgid(0, 0)
    for stream in (1, 2):
        os.dup2(out.fileno(), stream)
    out.close()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    status = main(list(arguments))
    sys.stdout.flush()
    os._exit(status)


def kill(copy: BaseProcess) -> None:
    """Kill -9 it and what it has started."""
    assert copy.pid is not None
    with contextlib.suppress(ProcessLookupError):
        os.killpg(copy.pid, signal.SIGKILL)
    copy.kill()  # it may not lead its group yet
    copy.join()


def status_of(work: Callable[[], object]) -> int:
    """Return the exit status of a copy, which must end."""
    with copied(work) as copy:
        copy.join(PATIENCE)
        assert copy.exitcode is not None, f"no end after {PATIENCE} s"
        return copy.exitcode
