"""Archives of casts: many files, one result each, on this machine or on a dask cluster."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from fitting.core.parameters import Parameter
from fitting.files import netcdf_writer
from fitting.files.cast_file import Reading, profile_of, raw_casts
from fitting.observations.profile import Profile
from fitting.profile.fit_profiles import ProfileFits, fit_profiles
from oceaninv.foundation.atomic_write import atomic_write, check_replaceable
from oceaninv.foundation.provenance import Provenance, recording, sha256
from oceaninv.transport.base import AbstractTransport

# Files that are read, fitted together and written before the next ones.
GROUP = 64


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of one file.

    `result`: the netCDF with its Kd, None if it has none; `casts`: how many were fitted;
    `problems`: sentences about the file or some of its casts; `resumed`: the result was there.
    """

    path: Path
    result: Path | None
    casts: int
    problems: tuple[str, ...]
    resumed: bool = False


@dataclasses.dataclass(frozen=True)
class Task:
    """How to read and fit; `depth_range` to `priors` as for `fit_profiles`.

    `overwrite`: replace files of the results' names that oceaninv did not write; `arguments`: those
    of the command that each result names, without files, folder and workers: results are equal
    whatever these are.
    """

    folder: Path
    reading: Reading = dataclasses.field(default_factory=Reading)
    depth_range: tuple[float, float] | None = None
    layers: int | None = 1
    transport: AbstractTransport | None = None
    priors: dict[str, Parameter] | None = None
    overwrite: bool = False
    arguments: tuple[str, ...] | None = None


def result_path(path: Path, folder: Path) -> Path:
    """Where the result of a file goes; its whole name stays, so that no two files share one."""
    return folder / f"{path.name}.kd.nc"


def _done(path: Path, folder: Path) -> bool:
    result = result_path(path, folder)
    return result.exists() and path.exists() and result.stat().st_mtime >= path.stat().st_mtime


def _read(path: Path, reading: Reading) -> tuple[list[Profile], list[str]]:
    profiles, problems = [], []
    try:
        raws = raw_casts(path, reading)
    except (ValueError, OSError) as error:
        return [], [str(error)]
    for raw in raws:
        try:
            profiles.append(profile_of(raw, reading))
        except ValueError as error:
            problems.append(str(error))
    return profiles, problems


def fit_group(paths: Sequence[Path], task: Task) -> list[Outcome]:
    """Read, fit and write some files."""
    read = [_read(path, task.reading) for path in paths]
    together = [profile for profiles, _ in read for profile in profiles]
    fits = fit_profiles(
        together,
        depth_range=task.depth_range,
        layers=task.layers,
        transport=task.transport,
        priors=task.priors,
    )
    outcomes, at = [], 0
    for path, (profiles, problems) in zip(paths, read, strict=True):
        own = fits.part(range(at, at + len(profiles)))
        at += len(profiles)
        problems += [*own.failures.values(), *own.water_failures.values()]
        fitted = len(profiles) - len(own.failures)
        target = result_path(path, task.folder) if fitted else None
        if target is not None:
            made_by = Provenance(task.arguments, ((path.name, sha256(path)),))
            with recording(made_by):
                _write(own, target, task.overwrite)
        outcomes.append(Outcome(path, target, fitted, tuple(problems)))
    return outcomes


def _write(fits: ProfileFits, target: Path, overwrite: bool) -> None:
    # Not by xarray: it takes nearly twice as long, and a lock of the cluster's for every file.
    with atomic_write(target, overwrite=overwrite) as temporary:
        temporary.unlink()  # the writer adds to a netCDF file or starts from nothing
        netcdf_writer.write(temporary, *fits.content(), mark=True)


def _check_results(files: list[Path], todo: list[Path], task: Task) -> None:
    """ValueError where a result would replace a file of the archive or one of somebody else's."""
    inputs = {path.resolve() for path in files}
    for path in todo:
        target = result_path(path, task.folder)
        if target.exists():
            if target.resolve() in inputs and not task.overwrite:
                raise ValueError(
                    f"the result of {path} would replace the input {target}: name another folder "
                    "with -o."
                )
            check_replaceable(target, overwrite=task.overwrite)


def fit_archive(
    paths: Iterable[str | Path], task: Task, cluster: str | None = None, group: int = GROUP
) -> Iterator[Outcome]:
    """Fits of all casts in many files, one netCDF beside the other in `task.folder`.

    Results that are there and not older than their file are kept: an interrupted run goes on
    where it stopped.  A file that cannot be used is reported and skipped.  `cluster`: address of
    a dask scheduler, whose workers see the same files.  What is written depends neither on
    `group` nor on the number of workers.

    Yields an `Outcome` per file as they become ready.
    """
    task.folder.mkdir(parents=True, exist_ok=True)
    files = [Path(path) for path in paths]
    count = Counter(path.name for path in files)
    twice = next((name for name, number in count.items() if number > 1), None)
    if twice is not None:
        raise ValueError(f"two files are named {twice}: their results would be one file.")
    todo = []
    for path in files:
        if _done(path, task.folder):
            yield Outcome(path, result_path(path, task.folder), 0, (), resumed=True)
        else:
            todo.append(path)
    _check_results(files, todo, task)
    groups = [todo[i : i + group] for i in range(0, len(todo), group)]
    if cluster is None:
        for paths in groups:
            yield from fit_group(paths, task)
        return
    try:
        from dask.distributed import Client, as_completed
    except ImportError:
        raise ValueError("a cluster needs dask; install oceaninv[cluster].") from None
    with Client(cluster, timeout="30s") as client:
        futures = [client.submit(fit_group, paths, task, pure=False) for paths in groups]
        for future in as_completed(futures):
            yield from future.result()
