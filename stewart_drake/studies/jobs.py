"""Many independent runs, in parallel on this machine or a Dask cluster, resumable at any time.

A job is a named call of a function that returns the bytes of a file. Ctrl-C, kill -9, a dead worker
or a full disk lose only the jobs in flight. The next start in the same folder does what is missing.
Only this process writes, so workers need no common file system.
"""

import asyncio
import fcntl
import json
import logging
import os
import pickle
import re
import signal
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, Final, NamedTuple

import cloudpickle
import joblib
from typing_extensions import TypeVar

from stewart_drake.files.errors import ConfigError, optional
from stewart_drake.files.fileio import remove_partials, write_whole
from stewart_drake.files.jsonio import jsonable, load_json
from stewart_drake.files.yamlio import brief

MANIFEST: Final = "manifest.json"
"""File of the settings that all jobs of a folder share."""

Job = tuple[Any, ...]
"""Arguments of one call, pickled."""
Progress = Callable[[int, int], None]
"""Called with the number of finished jobs and of all jobs."""
T = TypeVar("T", default=Path)
_Call = Callable[[], tuple[str, bytes]]

_LOCK: Final = ".lock"
_MAX_MANIFEST: Final = 10_000_000
_WATCH: Final = 0.5
"""Time between two checks by a worker that the process that started it is alive, s."""
_CONNECT_TIMEOUT: Final = 10.0
"""Longest wait for the scheduler, and for its first worker, s."""
_RESUME: Final = "finished jobs are kept and the same command continues from there"
_log: Final = logging.getLogger("stewart_drake")


def run_jobs(
    jobs: Mapping[str, Job],
    function: Callable[..., bytes],
    folder: str | Path,
    *,
    settings: Mapping[str, Any],
    suffix: str = ".json",
    read: Callable[[Path], T] = lambda path: path,  # type: ignore[assignment, return-value]
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> dict[str, T]:
    """Call `function(*jobs[key])` for every key whose file is missing or damaged.

    Ctrl-C stops the jobs in flight and raises KeyboardInterrupt; `function` must let it through.

    Args:
        jobs: by key; a key is a file name without its suffix, of letters, digits and `_.+-`.
        function: of a module, so that workers can import it. A job that cannot be sent to another
            process, such as one with a script's own class of a Drake system, runs in this one.
        folder: of the files KEY + suffix; made if it is missing.
        settings: of all jobs, plain data; a folder of other settings is refused.
        suffix: of the files.
        read: reads a file. If it raises ConfigError for a file of an earlier start, that job is
            done again, with a warning of one line from the package's logger.
        workers: number of processes on this machine, 1 or more, each with one numerical thread;
            all cores by default.
        scheduler: address of a Dask scheduler whose workers are used instead.
        progress: called at the start and for each finished job.

    Returns:
        The result of `read` for the file of every job, by default its path, in the order of `jobs`.

    Raises:
        ConfigError: the folder belongs to other settings or another process is working in it; the
            scheduler cannot be reached or its workers cannot be used.
        ChildProcessError: a worker process died, e.g. for want of memory.
        Exception: the exception of `function`, with a note that names the job.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = {key: folder / f"{key}{suffix}" for key in jobs}
    report = progress or (lambda *_: None)
    with _locked(folder):
        remove_partials(folder)
        _check_manifest(folder, settings, suffix)
        found = _finished(paths, read)
        calls = [partial(_named, k, function, job) for k, job in jobs.items() if k not in found]
        made = _on_this_machine(workers, calls) if scheduler is None else _on_dask(scheduler, calls)
        report(len(found), len(jobs))
        with closing(made):
            for key, data in made:
                write_whole(paths[key], data)
                found[key] = read(paths[key])
                report(len(found), len(jobs))
    return {key: found[key] for key in jobs}


def part_of(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Return the progress of jobs that are part of `total`, after `before` others."""
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)


def _finished(paths: Mapping[str, Path], read: Callable[[Path], T]) -> dict[str, T]:
    """Read the files of an earlier start; warn of damaged ones."""
    found, damaged = {}, []
    for key, path in paths.items():
        try:
            if path.exists():
                found[key] = read(path)
        except ConfigError as error:
            damaged.append(error)
    if damaged:
        more = f" (and {len(damaged) - 1} more)" if len(damaged) > 1 else ""
        _log.warning("%s; this run is done again%s", damaged[0], more)
    return found


def _named(key: str, function: Callable[..., bytes], job: Job) -> tuple[str, bytes]:
    """Call a job; an exception names it."""
    try:
        return key, function(*job)
    except ConfigError as error:
        raise ConfigError(f"{key}: {error}") from None
    except (Exception, SystemExit) as error:  # the latter is how some of Drake's checks end
        error.add_note(f"raised by the job {key}")
        raise


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder for this process; the lock ends with the process, also after kill -9."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    with open(os.open(folder / _LOCK, flags, 0o666), "rb", buffering=0) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{folder}: another process is working in this folder; wait for it to end, or "
                "choose another folder"
            ) from None
        yield


def _check_manifest(folder: Path, settings: Mapping[str, Any], suffix: str) -> None:
    """Write the manifest of a new folder, or compare that of an earlier start."""
    path, mine = folder / MANIFEST, jsonable(settings)
    if not path.exists():
        if any(not p.name.startswith(".") for p in folder.glob(f"*{suffix}")):
            raise ConfigError(
                f"{folder}: has {suffix} files but no {MANIFEST}; expected an empty folder, or one "
                "that an earlier start has made"
            )
        write_whole(path, json.dumps({"settings": mine}, indent=2, allow_nan=False) + "\n")
        return
    expected = "the manifest of the runs in its folder (choose another folder, or delete this one)"
    theirs = load_json(path, _MAX_MANIFEST, expected).get("settings")
    if not isinstance(theirs, dict):
        raise ConfigError(f"{path}: has no settings; expected {expected}")
    if theirs != mine:
        raise ConfigError(
            f"{folder}: belongs to other settings ({_difference(theirs, mine)}); "
            "expected the same settings as before, or another folder"
        )


def _difference(theirs: Any, mine: Any, name: str = "") -> str:
    """Return the first field in which two sets of plain settings differ."""
    if isinstance(theirs, dict) and isinstance(mine, dict):
        for key in sorted(theirs.keys() | mine.keys()):
            if theirs.get(key) != mine.get(key):
                return _difference(theirs.get(key), mine.get(key), f"{name}.{key}".strip("."))
    return f"{name or 'settings'}: {brief(theirs)} there, {brief(mine)} now"


# ---------------------------------------------------------------- this machine


class _Unreadable(NamedTuple):
    """Job that a worker could not read."""

    number: int
    reason: str


# cloudpickle sends a class of a script or notebook by value. A class that derives from one of
# pydrake cannot be rebuilt from that. The attempt would end the worker if the executor made it, so
# `_call_packed` makes it.
def _pack(call: _Call) -> bytes | str:
    """Return a call as bytes, or the reason why it cannot be sent."""
    try:
        return cloudpickle.dumps(call)
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _call_packed(number: int, packed: bytes | str) -> tuple[str, bytes] | _Unreadable:
    """Unpack and run a call in a worker."""
    if isinstance(packed, str):
        return _Unreadable(number, packed)
    try:
        call: _Call = pickle.loads(packed)
    except Exception as error:
        return _Unreadable(number, f"{type(error).__name__}: {error}")
    try:
        return call()
    except Exception as error:
        try:
            pickle.loads(cloudpickle.dumps(error))
        except Exception:
            plain = RuntimeError(f"{type(error).__name__}: {error}")
            plain.__notes__ = getattr(error, "__notes__", [])
            raise plain from None
        raise


def _on_this_machine(workers: int | None, calls: Sequence[_Call]) -> Generator[tuple[str, bytes]]:
    """Yield the results of calls as they finish; closing the iterator ends the workers."""
    number = min(workers or joblib.cpu_count(), max(1, len(calls)))
    if number == 1:
        yield from (call() for call in calls)
        return
    backend = joblib.parallel_config(
        backend="loky", inner_max_num_threads=1, initializer=_end_with, initargs=(os.getpid(),)
    )
    # joblib warns of results that are not fetched, as after Ctrl-C or an exception.
    with backend, warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning, module="joblib")
        parallel = joblib.Parallel(n_jobs=number, batch_size=1, return_as="generator_unordered")
        with _signals_blocked():
            outcomes = parallel(
                joblib.delayed(_call_packed)(i, _pack(call)) for i, call in enumerate(calls)
            )
        try:
            with closing(outcomes):
                for outcome in outcomes:
                    if isinstance(outcome, _Unreadable):
                        _log.debug("a job runs here: no process could read it (%s)", outcome.reason)
                        outcome = calls[outcome.number]()
                    yield outcome
        except BrokenProcessPool as error:
            codes = re.search(r"exit codes of the workers are \{(.*)\}", str(error))
            raise ChildProcessError(
                f"a worker process was killed{f' ({codes[1]})' if codes else ''}, perhaps for want "
                f"of memory; {_RESUME}"
            ) from None


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Start processes that Ctrl-C and SIGTERM to the group do not reach, and quiet trackers.

    A process inherits the signal mask of the thread that starts it, and a thread likewise; Ctrl-C
    would break the imports of a worker in the middle. The tracker is started before the signals are
    blocked, because some Pythons unblock them there. The tracker removes the resources that a
    killed worker leaves; its warnings about them are turned off.
    """
    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, [before, "ignore:resource_tracker"]))
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        del os.environ["PYTHONWARNINGS"]
        if before is not None:
            os.environ["PYTHONWARNINGS"] = before


def _end_with(parent: int) -> None:
    """End a worker process with the one that started it, also after kill -9."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# ---------------------------------------------------------------- a Dask cluster


# joblib's backend for Dask waits for ever if workers die during a call, so futures are used here.
def _on_dask(scheduler: str, calls: Sequence[_Call]) -> Generator[tuple[str, bytes]]:
    """Yield the results of calls as they finish; closing the iterator cancels the others."""
    install = "install it with pip install distributed"
    dask = optional("distributed", f"--scheduler: needs the package distributed; {install}")
    try:
        _greet(dask, scheduler)
        client = dask.Client(scheduler, timeout=_CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # the last if TLS is not configured
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
        if threads > 1:  # the compiled equations of motion have one set of buffers per process
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
                f"Dask gave up a job whose workers died one after the other; {_RESUME}"
            ) from None
        except dask.CancelledError:
            raise ChildProcessError(f"the scheduler {scheduler} went away; {_RESUME}") from None
        except ModuleNotFoundError as error:
            raise ConfigError(
                f"--scheduler: the workers of {scheduler} lack a module ({error}); install the "
                "same stewart-drake there"
            ) from None


def _greet(dask: Any, scheduler: str) -> None:
    """Connect once without a client: a client without a scheduler leaves an event loop running."""
    options = dask.Security().get_connection_args("client")

    async def greet() -> None:
        await (await dask.comm.connect(scheduler, timeout=_CONNECT_TIMEOUT, **options)).close()

    # The calling thread may have an event loop already, as in a notebook.
    with ThreadPoolExecutor(1) as thread:
        thread.submit(asyncio.run, greet()).result()
