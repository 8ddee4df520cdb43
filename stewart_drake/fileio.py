"""Files: read up to a limit, written whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stewart_drake.errors import ConfigError


def read_bytes(path: Path, most: int, expected: str) -> bytes:
    """What a file holds.

    Args:
        path: of a regular file; a folder, a pipe or a device is refused unread.
        most: number of bytes above which it is refused.
        expected: in words, closing every message.

    Raises:
        ConfigError: one line, opened by the path.
    """
    try:
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path}: is not a file; expected {expected}")
        with path.open("rb") as stream:
            raw = stream.read(most + 1)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}); expected {expected}"
        ) from None
    except ConfigError:
        raise
    except ValueError:  # a zero byte, half a surrogate pair
        raise ConfigError(f"{str(path)!r}: is no file name; expected {expected}") from None
    if len(raw) > most:
        limit = f"{most // 1_000_000} MB" if most >= 1_000_000 else f"{most // 1000} kB"
        raise ConfigError(f"{path}: is larger than {limit}; expected {expected}")
    return raw


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to; at the end what is there takes the place of `path`.

    Readers, and whoever comes after a kill -9, see the old file or the new one. On an error, such
    as a full disk, the old file stays and nothing is left beside it.

    Raises:
        OSError: `path` cannot be replaced, e.g. because it is a folder.
    """
    partial = path.with_name(f".{path.name}.part")
    try:
        yield partial
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
