"""`oceaninv rerun`: repeat a fit from its result and compare both."""

import contextlib
import io
import re
import shlex
import tempfile
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
import typer.main

from fitting.commands.fit_photo import fit_photo_command
from fitting.commands.fit_profile import fit_archive_again, fit_profile_command
from fitting.commands.shared_options import status
from oceaninv.foundation.atomic_write import is_own
from oceaninv.foundation.provenance import Provenance, current, recording, sha256, version

_COMMANDS: dict[str, Callable] = {
    "fit-profile": fit_profile_command,
    "fit-photo": fit_photo_command,
}
# Arguments of these commands that name files or folders: those that are read, those that would be
# written, and a network address.  `rerun` refuses a command with any other.
READ = ("paths", "picture_of", "range_map", "intrinsics")
NOT_REPEATED: dict[str, Any] = {
    "output": None, "table": None, "report": False, "overwrite": False, "cluster": None,
}  # fmt: skip
_INPUT = re.compile(r"(.+?) \(SHA-256 ([0-9a-f]{64})\)(?:; |$)")
# Differences of what is exactly 0 but for rounding would be no relative ones.
_OF_UNIT_SIZE = ("correlation",)


def rerun_command(
    result: Annotated[Path, typer.Argument(help="Result of a fit, STEM.nc.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="File to write, by default STEM_rerun.nc; it must not exist."
        ),
    ] = None,
    inputs: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the files that the fit read; by default this one, then that of the "
            "result."
        ),
    ] = None,
) -> None:
    """Repeat a fit with the command, options and inputs that its result names, and compare.

    Inputs must have the checksums that the result names.  Pictures, tables and reports are not
    written again.
    """
    target = output or result.with_name(f"{result.stem}_rerun.nc")
    _check_target(target)
    record = _record_of(result)
    repeat = _parsed(record, result)
    folders = [Path(), result.parent] if inputs is None else [inputs]
    _take_inputs(repeat, record, folders, result)
    if record.version != version():
        print(
            f"{result} was made by oceaninv {record.version}; this is {version()}, and numbers may "
            "differ"
        )
    with tempfile.TemporaryDirectory(prefix="oceaninv-") as name:
        made = _repeated(repeat, record, Path(name))
        differences = list(_differences(result, made))
        _write_new(target, made.read_bytes())
    print(f"wrote {target}")
    _print_differences(differences)


class _Record(NamedTuple):
    """What a result says of its making: `inputs` are names and checksums; `archive`: whether it is
    of one file among many."""

    version: str
    words: list[str]
    inputs: list[tuple[str, str]]
    archive: bool


def _check_target(target: Path) -> None:
    if target.exists() or target.is_symlink():
        raise ValueError(f"{target} exists, and rerun replaces nothing: name another file with -o.")
    if not target.parent.is_dir():
        raise ValueError(f"cannot write {target}: the folder {target.parent} does not exist.")


def _write_new(target: Path, content: bytes) -> None:
    """Write a file that was not there; never over one that came to be in the meantime."""
    try:
        file = target.open("xb")
    except FileExistsError:
        _check_target(target)
        raise
    except OSError as error:
        raise ValueError(f"cannot write {target}: {error.strerror}.") from None
    try:
        with file:
            file.write(content)
    except OSError:
        target.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A netCDF-4 file; ValueError, naming it, for whatever goes wrong with its content."""
    import h5py

    if not path.is_file():
        raise ValueError(f"{path} does not exist or is no file: name the result of a fit.")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except Exception as error:  # every library below has its own way to say "damaged"
        what = " ".join(str(error).split())[:200]
        raise ValueError(
            f"{path} cannot be read as netCDF; it may be half-written or damaged ({what})."
        ) from None


def _record_of(path: Path) -> _Record:
    with _opened(path) as file:
        attributes = {name: file.attrs.get(name) for name in _FACTS}
        archive = "cast" in file
    version, command, inputs = (_text(attributes[name]) for name in _FACTS)
    if not is_own(path) or version is None or inputs is None:
        raise ValueError(f"{path} is no result of oceaninv that names its version and inputs.")
    if command is None:
        raise ValueError(f"{path} names no command: it was made in Python, and is repeated there.")
    found = _INPUT.findall(inputs)
    if "".join(f"; {name} (SHA-256 {digest})" for name, digest in found)[2:] != inputs:
        raise ValueError(f"{path}: input_files is {inputs[:80]!r}; names with checksums wanted.")
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise ValueError(f"{path}: command_line cannot be read ({error}).") from None
    if words[:1] != ["oceaninv"] or len(words) < 2:
        raise ValueError(f"{path}: command_line is {command[:80]!r}, no command of oceaninv.")
    return _Record(" ".join(version.split())[:40], words[1:], found, archive)


_FACTS = ("oceaninv_version", "command_line", "input_files")


def _text(value: Any) -> str | None:
    """An attribute that is a text; None where it is absent or something else."""
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    return value if isinstance(value, str) else None


def _parsed(record: _Record, path: Path) -> Any:
    """The context of the command as the command line itself reads it; no shell takes part.

    Of what the command would write nothing is left.  ValueError unless it is one of `_COMMANDS`
    with arguments that are known here.
    """
    name, *words = record.words
    if name not in _COMMANDS:
        raise ValueError(
            f"{path} was made by {name[:40]!r}; rerun repeats {' and '.join(_COMMANDS)}."
        )
    app = typer.Typer(add_completion=False)
    app.command(name)(_COMMANDS[name])
    command: Any = typer.main.get_command(app)
    # Otherwise --help would print and end here.
    command.add_help_option = False
    if record.archive:  # their results do not name the files in the command
        words += ["--", *(name for name, _ in record.inputs)]
    try:
        context = command.make_context(name, words)
    except Exception as error:  # of classes that differ between versions of typer
        told: Any = getattr(error, "format_message", error.__str__)
        what = " ".join(told().split())[:200]
        raise ValueError(f"{path}: its command cannot be repeated: {what}") from None
    unknown = names_of_files(_COMMANDS[name]) - {*READ, *NOT_REPEATED}
    if unknown:
        raise ValueError(f"{path}: rerun does not know what {min(unknown)} names.")
    context.params |= {k: v for k, v in NOT_REPEATED.items() if k in context.params}
    return context


def names_of_files(command: Callable) -> set[str]:
    """The arguments of a command that are names of files or folders."""

    def holds_path(hint: Any) -> bool:
        return hint is Path or any(map(holds_path, typing.get_args(hint)))

    return {name for name, hint in typing.get_type_hints(command).items() if holds_path(hint)}


def _take_inputs(repeat: Any, record: _Record, folders: list[Path], result: Path) -> None:
    """Let the command read the files of the recorded checksums; ValueError for one that is not
    there or another one."""
    digests: dict[str, list[str]] = {}
    for name, digest in record.inputs:
        digests.setdefault(name, []).append(digest)

    def found(given: Any) -> Path:
        path = Path(str(given))
        wanted = digests.get(path.name)
        if wanted is None:
            raise ValueError(f"{result} names no checksum of its input {path.name}.")
        places = [folder / part for folder in folders for part in (path, Path(path.name))]
        seen = {place: sha256(place) for place in dict.fromkeys(places) if place.is_file()}
        for place, digest in seen.items():
            if digest in wanted:
                return place
        if not seen:
            where = " or ".join(dict.fromkeys(str(place.parent) for place in places))
            raise ValueError(
                f"the input {path.name} (SHA-256 {wanted[0]}) is not in {where}: name its folder "
                "with --inputs."
            )
        place, digest = next(iter(seen.items()))
        raise ValueError(
            f"the input {place} has changed: its SHA-256 is {digest}, that of the file that was "
            f"fitted is {wanted[0]}."
        )

    values = repeat.params
    for name in READ:
        if isinstance(values.get(name), (list, tuple)):
            values[name] = [found(one) for one in values[name]]
        elif values.get(name) is not None:
            values[name] = found(values[name])


def _repeated(repeat: Any, record: _Record, folder: Path) -> Path:
    """The new result, in `folder`; what the command prints is left out."""
    values = repeat.params
    made = folder / "fit.nc"
    if record.archive:
        made = folder / f"{Path(values['paths'][0]).name}.kd.nc"
    values["output"] = folder if record.archive else folder / "fit"
    arguments = Provenance(tuple(record.words), current().inputs)
    message = "repeating the fit"
    try:
        with recording(arguments), contextlib.redirect_stdout(io.StringIO()), status(message):
            if record.archive:
                fit_archive_again(values, tuple(record.words))
            else:
                repeat.command.invoke(repeat)
    except ValueError as error:
        if not made.exists():  # otherwise the fit said the same of a step that failed
            raise
        print(f"the fit was written, but: {error}")
    if not made.exists():
        raise ValueError(f"the repeated command wrote no {made.name}.")
    return made


class _Difference(NamedTuple):
    """Of one variable: the largest relative difference, or why there is none."""

    name: str
    largest: float
    why: str = ""


def _differences(old: Path, new: Path) -> Iterator[_Difference]:
    with _opened(old) as before, _opened(new) as after:
        a, b = _content(before), _content(after)
        for name in dict.fromkeys([*b, *a]):
            if name in a and name in b:
                yield _compared(name, a[name], b[name])
            else:
                which = "old" if name not in a else "new"
                yield _Difference(name, float("inf"), f"the {which} result lacks it")


def _content(file: Any) -> dict[str, Any]:
    """The variables of a result and of its groups, by "name" and "group/name".

    Links are not followed: they may lead to other files.
    """
    import h5py

    def own(place: Any, kind: type) -> dict[str, Any]:
        hard = [name for name in place if isinstance(place.get(name, getlink=True), h5py.HardLink)]
        found = {name: place[name] for name in hard}
        return {name: value for name, value in found.items() if isinstance(value, kind)}

    places = {"": file} | {f"{name}/": group for name, group in own(file, h5py.Group).items()}
    return {
        prefix + name: variable
        for prefix, place in places.items()
        for name, variable in own(place, h5py.Dataset).items()
        if not (_text(variable.attrs.get("NAME")) or "").startswith(_NO_VARIABLE)
    }


# What netCDF-4 writes for a dimension that has no variable.
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"


def _compared(name: str, before: Any, after: Any) -> _Difference:
    import numpy as np

    numbers = [one.dtype.kind in "fiub" for one in (before, after)]
    # Shapes first: what a damaged file claims to hold is not read.
    if before.shape != after.shape or numbers[0] != numbers[1]:
        return _Difference(name, float("inf"), "its shapes or types differ")
    a, b = before[()], after[()]
    if all(numbers):
        scale = 1.0 if name.rpartition("/")[2] in _OF_UNIT_SIZE else None
        return _Difference(name, largest_difference(a, b, scale))
    return _Difference(name, 0.0, "" if np.array_equal(a, b) else "its texts differ")


def largest_difference(a: Any, b: Any, scale: float | None = None) -> float:
    """Largest |a - b| over the larger of |a| and |b|, or over `scale`; infinite where only one is
    a number.

    >>> import numpy as np
    >>> float(largest_difference(np.array([1.0, np.nan]), np.array([1.25, np.nan])))
    0.2
    """
    import numpy as np

    a, b = (np.asarray(value, dtype=np.float64) for value in (a, b))
    equal = (a == b) | (np.isnan(a) & np.isnan(b))
    with np.errstate(all="ignore"):
        size = np.maximum(np.abs(a), np.abs(b)) if scale is None else scale
        apart = np.where(equal, 0.0, np.abs(a - b) / size)
    return float(np.max(np.where(np.isnan(apart), np.inf, apart), initial=0.0))


def _print_differences(differences: list[_Difference]) -> None:
    for one in differences:
        if one.why:
            print(f"{one.name} cannot be compared: {one.why}")
    compared = [one for one in differences if not one.why]
    if not compared:
        print("no variable could be compared")
        return
    worst = max(compared, key=lambda one: one.largest)
    where = f", in {worst.name}" if worst.largest else ""
    print(f"largest relative difference of {len(compared)} variables: {worst.largest:.2g}{where}")
