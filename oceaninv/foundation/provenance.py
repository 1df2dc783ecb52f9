"""What made a file and when: version, date, command line, input files with their checksums."""

import contextlib
import contextvars
import dataclasses
import datetime
import functools
import hashlib
import os
import re
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path

from oceaninv.foundation.atomic_write import MARK

# An absolute path at the start of an argument, of the value of an option, or of a name=value pair.
_ABSOLUTE = re.compile(r"(-[a-z]|[\w-]+=)?(?:~|[A-Za-z]:)?[/\\](?:.*[/\\])?([^/\\]+)[/\\]?")
# Folders of an absolute path within a text.
_FOLDERS = re.compile(r"(?<![\w.~/\\-])(?:~|[A-Za-z]:)?[/\\](?:[^\s,;:'\"/\\]+[/\\])+")


@functools.cache
def version() -> str:
    """The version of oceaninv that is installed; "unknown" where its files alone are there."""
    from importlib import metadata

    try:
        return metadata.version("oceaninv")
    except metadata.PackageNotFoundError:
        return "unknown"


def date_created() -> str:
    """Now in UTC as ISO 8601, to the second.

    Where the environment sets SOURCE_DATE_EPOCH, whole seconds since 1970, that moment: results of
    equal inputs are then equal bit by bit (https://reproducible-builds.org/specs).

    **Raises:** `ValueError` where SOURCE_DATE_EPOCH is no such number.
    """
    given = os.environ.get("SOURCE_DATE_EPOCH")
    try:
        seconds = None if given is None else int(given)
        moment = datetime.datetime.now(datetime.UTC)
        if seconds is not None:
            moment = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    except (ValueError, OverflowError, OSError):
        raise ValueError(
            f"SOURCE_DATE_EPOCH is {given!r}; set it to whole seconds since 1970, or not at all."
        ) from None
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def without_folders(text: str) -> str:
    """`text` with its absolute paths reduced to the names of their files.

    Results are shared; the folders of the machine that made them are left out.

    >>> without_folders("/home/me/dives/cast.csv:2")
    'cast.csv:2'
    """
    parts = []
    for part in text.split("; "):
        whole = _ABSOLUTE.fullmatch(part)
        parts.append((whole[1] or "") + whole[2] if whole else _FOLDERS.sub("", part))
    return "; ".join(parts)


def sha256(path: str | Path) -> str:
    """The SHA-256 checksum of a file, in hexadecimal digits."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclasses.dataclass(frozen=True)
class Provenance:
    """What made a result.

    `arguments`: those of the command, None for results of Python; `inputs`: name and SHA-256
    checksum of every file that was read.
    """

    arguments: tuple[str, ...] | None = None
    inputs: tuple[tuple[str, str], ...] = ()

    @property
    def command(self) -> str | None:
        """The command as it was given, on one line, absolute paths reduced to names."""
        if self.arguments is None:
            return None
        text = shlex.join(["oceaninv", *map(without_folders, self.arguments)])
        return re.sub(r"[\x00-\x1f\x7f]+", " ", text)

    @property
    def facts(self) -> dict[str, str]:
        """What is known, by name: oceaninv_version, date_created, command_line, input_files."""
        found = {"oceaninv_version": version(), "date_created": date_created()}
        if self.command is not None:
            found["command_line"] = self.command
        if self.inputs:
            files = (f"{name} (SHA-256 {digest})" for name, digest in self.inputs)
            found["input_files"] = re.sub(r"[\x00-\x1f\x7f]+", " ", "; ".join(files))
        return found

    @property
    def lines(self) -> list[str]:
        """The facts as lines "name: value", for comments of text files."""
        return [f"{name}: {value}" for name, value in self.facts.items()]

    @property
    def history(self) -> str:
        """One line: the date, the mark of files of oceaninv, the version and the command."""
        made = f"{date_created()}: {MARK} {version()}"
        return made + (f": {self.command}" if self.command else "")


_CURRENT: contextvars.ContextVar[Provenance] = contextvars.ContextVar("provenance")


def current() -> Provenance:
    """The provenance of what is written now; that of Python outside of `recording`."""
    return _CURRENT.get(Provenance())


@contextlib.contextmanager
def recording(provenance: Provenance) -> Iterator[None]:
    """Let all files that are written in the block carry `provenance`."""
    token = _CURRENT.set(provenance)
    try:
        yield
    finally:
        _CURRENT.reset(token)


def record_inputs(paths: Iterable[str | Path]) -> None:
    """Let what is written from now on, to the end of `recording`, name these files as inputs."""
    files = dict.fromkeys(Path(path) for path in paths)
    inputs = tuple((path.name, sha256(path)) for path in files if path.is_file())
    _CURRENT.set(dataclasses.replace(current(), inputs=inputs))
