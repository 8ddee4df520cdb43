"""Files: read up to a limit, written whole or not at all."""

import contextlib
import fcntl
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from stewart_drake.files.errors import ConfigError

_CHUNK: Final = 1 << 24
_NAME: Final = 40
"""Letters of a file's name that its temporary name shows; a name has at most 255 bytes."""
_PARTIAL: Final = re.compile(r"\..{1,40}\.[0-9a-f]{16}\.part", re.DOTALL)


def read_bytes(path: Path, most: int, expected: str) -> bytes:
    """What a file holds.

    Args:
        path: of a regular file; a folder, a pipe or a device is refused unread.
        most: number of bytes above which it is refused.
        expected: in words, closing every message.

    Raises:
        ConfigError: one line, opened by the path.
    """
    # The kind is asked of what has been opened, so that nothing can be put in its place between
    # the two; O_NONBLOCK lets a pipe without a writer be opened, and refused, at once.
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
        try:
            found = os.fstat(descriptor)
            if not stat.S_ISREG(found.st_mode):
                raise ConfigError(f"{path}: is not a file; expected {expected}")
            # A file may grow meanwhile, and those of /proc say that they have no size.
            raw = bytearray()
            while found.st_size <= most and len(raw) <= most:
                chunk = os.read(descriptor, min(_CHUNK, most + 1 - len(raw)))
                if not chunk:
                    return bytes(raw)
                raw += chunk
        finally:
            os.close(descriptor)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}); expected {expected}"
        ) from None
    except ConfigError:
        raise
    except ValueError:  # a zero byte, half a surrogate pair
        raise ConfigError(f"{str(path)!r}: is no file name; expected {expected}") from None
    limit = f"{most // 1_000_000} MB" if most >= 1_000_000 else f"{most // 1000} kB"
    raise ConfigError(f"{path}: is larger than {limit}; expected {expected}")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to; at the end what is there takes the place of `path`.

    Readers, and whoever comes after a kill -9 or a loss of power, see the old file or the new one.
    On an error, such as a full disk, the old file stays and nothing is left beside it; what a kill
    -9 leaves there is cleared by `remove_partials`. The permissions of a replaced file stay.

    Raises:
        OSError: `path` cannot be written or replaced, e.g. because it is a folder; it is named.
    """
    old = None
    with contextlib.suppress(OSError):
        old = os.lstat(path)
    mode = stat.S_IMODE(old.st_mode) & 0o777 if old and stat.S_ISREG(old.st_mode) else None
    partial, descriptor = _new_partial(path, 0o666 if mode is None else 0o600)
    try:
        try:
            yield partial
            if mode is not None:
                with contextlib.suppress(OSError):  # a file system that has no permissions
                    os.fchmod(descriptor, mode)
            os.fsync(descriptor)
            os.replace(partial, path)
        finally:
            os.close(descriptor)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        # A failing write, such as on a full disk, names no file, others name the temporary one.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(partial)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def remove_partials(folder: Path) -> None:
    """Clear what writers that were killed have left; files that are being written stay."""
    for entry in os.scandir(folder):
        if not _PARTIAL.fullmatch(entry.name):
            continue
        with contextlib.suppress(OSError):  # another user's, or gone meanwhile
            descriptor = os.open(entry, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(entry)
            finally:
                os.close(descriptor)


def _new_partial(path: Path, mode: int) -> tuple[Path, int]:
    """A file beside `path` that was not there before, and its descriptor.

    Its name cannot be guessed and no link is followed, so that nobody else who may write to the
    folder chooses what is overwritten. It is locked, which tells it from what was left behind: a
    lock ends with its process.
    """
    while True:
        partial = path.with_name(f".{path.name[:_NAME]}.{secrets.token_hex(8)}.part")
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            descriptor = os.open(partial, flags, mode)
        except OSError as error:
            error.filename = str(path)
            raise
        with contextlib.suppress(OSError):  # a file system without locks, where nothing is cleared
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return partial, descriptor
        os.close(descriptor)  # cleared by another process between creation and lock
