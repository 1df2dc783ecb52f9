"""Files written whole or not at all, and never over a file that oceaninv did not write."""

import contextlib
import hashlib
import mmap
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

# This text stands uncompressed in every file that oceaninv writes: as an attribute, a text chunk
# or a comment.  Text files add a checksum, so that one that was edited counts as the user's own.
MARK = "written by oceaninv"
_CHECKSUM = re.compile(rf"({MARK}; checksum )([0-9a-f]{{16}})".encode())


@contextlib.contextmanager
def atomic_write(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary path beside `path` that replaces `path` only when the block ends well.

    A link is followed: the file it points to is written.  Raises ValueError where there can be no
    such file, and where a file of that name exists that oceaninv did not write, unless
    `overwrite`.
    """
    path = Path(path)
    check_replaceable(path, overwrite=overwrite)
    target = path.resolve()
    temporary = _temporary_beside(target)
    try:
        yield temporary
        temporary.chmod(0o644)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: str | Path, *, overwrite: bool = False) -> None:
    """Raise, before the work, the ValueError that `atomic_write` would raise after it."""
    check_replaceable(path, overwrite=overwrite)
    _temporary_beside(Path(path).resolve()).unlink()


def check_replaceable(path: str | Path, *, overwrite: bool = False) -> None:
    """ValueError where `path` is a file that oceaninv did not write, unless `overwrite`."""
    path = Path(path)
    if path.is_file() and not overwrite and not is_own(path):
        raise ValueError(
            f"{path} exists and oceaninv did not write it, or it was edited since: name another "
            "output, or replace it with --overwrite (in Python, overwrite=True)."
        )


def is_own(path: str | Path) -> bool:
    """Whether oceaninv wrote this file and, if it is text, it has not been edited since."""
    with Path(path).open("rb") as file:
        if os.fstat(file.fileno()).st_size == 0:
            return False
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            if content.find(MARK.encode()) < 0:
                return False
            stated = _CHECKSUM.search(content)
            return stated is None or stated[2] == _checksum(content[:])


def with_checksum(text: str) -> str:
    """`text`, which holds `checksum_line()` once, with the checksum of the rest filled in."""
    stated = f"{MARK}; checksum {_checksum(text.encode()).decode()}"
    return text.replace(checksum_line(), stated, 1)


def checksum_line() -> str:
    """What a text file holds in a comment before `with_checksum`."""
    return f"{MARK}; checksum {'0' * 16}"


def _checksum(content: bytes) -> bytes:
    blank = _CHECKSUM.sub(rb"\g<1>" + b"0" * 16, content.replace(b"\r\n", b"\n"), count=1)
    return hashlib.sha256(blank).hexdigest()[:16].encode()


def _temporary_beside(path: Path) -> Path:
    """An empty file beside `path`; ValueError where there can be none."""
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: the folder {path.parent} does not exist.")
    if path.is_dir():
        raise ValueError(f"cannot write {path}: a folder has that name.")
    if path.exists() and not path.is_file():
        raise ValueError(f"cannot write {path}: it is no ordinary file.")
    prefix = f".{path.stem[:100]}-"
    try:
        handle, name = tempfile.mkstemp(suffix=path.suffix, prefix=prefix, dir=path.parent)
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error.strerror}.") from None
    os.close(handle)
    return Path(name)
