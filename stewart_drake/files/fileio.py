"""Files: read up to a limit, written whole or not at all."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from stewart_drake.files.errors import ConfigError

_NAME: Final = 40  # letters of a file's name in its temporary name; a name has at most 255 bytes


def read_bytes(path: Path, most: int, expected: str) -> bytes:
    """Return the content of a file.

    Args:
        path: of a regular file; a folder, a pipe or a device is refused.
        most: largest accepted number of bytes.
        expected: description of the file, closing every message.
    """
    try:
        if path.exists() and not path.is_file():
            problem = f"{path}: is not a file"
        elif path.stat().st_size <= most:
            return path.read_bytes()
        else:
            limit = f"{most // 1_000_000} MB" if most >= 1_000_000 else f"{most // 1000} kB"
            problem = f"{path}: is larger than {limit}"
    except OSError as error:
        problem = f"{path}: cannot be read ({error.strerror})"
    except ValueError:  # a zero byte, half a surrogate pair
        problem = f"{str(path)!r}: is not a file name"
    raise ConfigError(f"{problem}; expected {expected}") from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder, and replace `path` by what was written to it.

    After a crash or a loss of power `path` is the old file or the new one. On an error the old file
    stays and the temporary one is removed. A replaced file keeps its permissions.

    Raises:
        OSError: `path` cannot be written or replaced, e.g. because it is a folder. The error names
            `path`, not the temporary file.
    """
    partial = path.with_name(f".{path.name[:_NAME]}.{secrets.token_hex(8)}.part")
    try:
        yield partial
        if path.is_file():
            with contextlib.suppress(OSError):  # a file system without permissions
                shutil.copymode(path, partial)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        partial.unlink(missing_ok=True)
        # An error of `write`, as on a full disk, names no file; others name the temporary one.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(partial)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def make_folder(name: str, path: Path) -> None:
    """Make a folder and those above it.

    Raises:
        ConfigError: that is not possible; `name`, of an argument, opens the message.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # a ValueError for a zero byte in the name
        raise unwritable(name, path, error) from None


def unwritable(name: str, path: Path, error: Exception, kind: str = "directory") -> ConfigError:
    """Return the error about a path, given by the argument or option `name`, for its cause."""
    return ConfigError(
        f"{name}: got {str(path)!r}; expected a {kind} that can be written "
        f"({getattr(error, 'strerror', None) or error})"
    )


def write_asked(name: str, path: str | Path, text: str) -> None:
    """Write the file that the argument `name` asks for, and make its folder.

    Raises:
        ConfigError: that is not possible.
    """
    make_folder(name, Path(path).parent)
    try:
        write_whole(Path(path), text)
    except (OSError, ValueError) as error:
        raise unwritable(name, Path(path), error, "file") from None


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file by `replacing`; text as UTF-8."""
    with replacing(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def remove_partials(folder: Path) -> None:
    """Remove the temporary files of killed writers; no other process may write in the folder."""
    for partial in folder.glob(".*.????????????????.part"):
        partial.unlink(missing_ok=True)
