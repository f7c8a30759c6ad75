"""Files as the system has them: what may be read, and writing a file completely or not at all."""

import errno
import hashlib
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from warp_ir.scene import InputError

_KINDS = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a directory",
}
"""What a path may lead to that is no regular file. To open a pipe would wait for someone to write."""
_PREFIX = ".warp-ir-"
_cleared: set[Path] = set()
"""Folders in which this process has looked for what killed processes have left."""


def check_input(path: str | os.PathLike[str], kind: str) -> None:
    """Checks that a file can be read, as far as that costs no time.

    Args:
        path: The file.
        kind: What it should be, such as "a USD file".

    Raises:
        InputError: There is no such file, it is no regular file, or its name is not UTF-8.
    """
    _check_name(path)
    if not os.path.exists(path):
        raise InputError(f"{os.fspath(path)}: no such file")
    other = special_kind(path)
    if other:
        raise InputError(f"{os.fspath(path)}: is {other}, not {kind}")


def special_kind(path: str | os.PathLike[str]) -> str:
    """What a path leads to if that is no regular file, such as "a pipe"; "" if it is one, or is not there."""
    try:
        kind = stat.S_IFMT(os.stat(path).st_mode)
    except (OSError, ValueError):
        return ""
    return "" if kind == stat.S_IFREG else _KINDS.get(kind, "no regular file")


def check_output(path: str | os.PathLike[str], suffixes: Sequence[str], *, make_folder: bool = False) -> Path:
    """Checks that a file can be written, before any work is done for it.

    Args:
        path: The file to write.
        suffixes: The known extensions, in lower case.
        make_folder: Whether to create the file's folder.

    Returns:
        The path.

    Raises:
        InputError: The file cannot be written.
    """
    path = Path(path)
    try:
        if "\0" in str(path):
            raise InputError(f"{str(path)!r}: a path cannot hold a null character")
        _check_name(path)
        if path.is_dir():
            raise InputError(f"{path}: is a folder; name the file to write")
        if path.suffix.lower() not in suffixes:
            raise InputError(f"{path}: unknown extension {path.suffix!r}; known are {' '.join(suffixes)}")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is not a regular file")
        if path.exists() and not os.access(path, os.W_OK):
            raise InputError(f"{path}: is write-protected")
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        elif not path.parent.exists():
            raise InputError(f"{path}: there is no folder {str(path.parent)!r}")
        _clear(path.parent)
        # Permissions, read-only and full file systems show only when a file is created.
        temporary = _temporary(path)
        temporary.open("xb").close()
        temporary.unlink()
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be written: {reason(error)}") from error
    return path


def check_room(folder: str | os.PathLike[str], size: int) -> None:
    """Raises `OSError` if a file of a size [bytes] cannot be written to a folder: a disk may be full, or a quota.

    For libraries that end the process where they cannot write.
    """
    with tempfile.TemporaryFile(prefix=_PREFIX, dir=folder) as file:
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
                return
        except OSError as error:
            if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):  # the file system cannot tell
                raise
    if shutil.disk_usage(folder).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path in the same folder, which replaces `path` on success and is removed otherwise.

    The data are on the disk before they take the name: after a power cut the file is the old one or the new one.

    Raises:
        InputError: Writing failed.
    """
    # A link is followed: its target is replaced, and not the link.
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    temporary = _temporary(target)
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {reason(error)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def reason(error: Exception) -> str:
    """The reason of an error in one line, without the path."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return first_line(str(error))


def first_line(text: str) -> str:
    """The first line of a message, "" if it has none; characters that cannot be printed are replaced."""
    lines = text.strip().splitlines()
    line = lines[0].strip() if lines else ""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)


def _check_name(path: str | os.PathLike[str]) -> None:
    """Raises `InputError` if a file's name is not UTF-8, which USD and OpenImageIO take all names for."""
    try:
        os.fspath(path).encode("utf-8")
    except UnicodeEncodeError:
        raise InputError(f"{os.fsencode(path)!r}: its name is not UTF-8") from None


def _temporary(path: Path) -> Path:
    """A hidden path in the same folder, with the same extension, that no other process uses."""
    return path.with_name(f"{_PREFIX}{_machine()}-{os.getpid()}-{os.urandom(4).hex()}{path.suffix}")


def _machine() -> str:
    """Tells apart the machines, and the containers, whose processes have numbers of their own."""
    names = [os.uname().nodename] if hasattr(os, "uname") else []
    with suppress(OSError):
        names.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.blake2b("".join(names).encode("utf-8", "replace"), digest_size=4).hexdigest()


def _clear(folder: Path) -> None:
    """Removes the temporary files of killed processes of this machine from a folder, once."""
    if folder in _cleared or os.name != "posix":
        return
    _cleared.add(folder)
    mine = f"{_PREFIX}{_machine()}-"
    with suppress(OSError):
        for file in folder.glob(f"{mine}*"):
            number = file.name.removeprefix(mine).partition("-")[0]
            if number.isdecimal() and not _is_running(int(number)):
                with suppress(OSError):
                    file.unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    return True
