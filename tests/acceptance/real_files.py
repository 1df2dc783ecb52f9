"""Files that users and public archives hold: what comes out, what is right, how that is known.

    python -m tests.acceptance.real_files FOLDER

FOLDER holds the files, one folder for each of the cases below; none of them may be redistributed.
Prints a table for each heading and writes real_files.md beside this file.  Ends with status 1 if
a case is not right.  The fast tests use synthetic siblings of known truth.
"""

import contextlib
import dataclasses
import io
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from fitting import read_photograph, read_range
from fitting.commands import main as cli
from fitting.images.chart_detection import find_charts
from fitting.images.chart_reading import read_chart
from tests.acceptance._folder import data_folder


@dataclasses.dataclass(frozen=True)
class Case:
    """One row of the table.

    - `heading`: of the table; `name`: what kind of file it is.
    - `folder`: where its files lie within FOLDER.
    - `run`: takes that folder; returns what came, and whether it is right.
    - `right`, `known`: what is right, and how that is known.
    """

    heading: str
    name: str
    folder: str
    run: Callable[[Path], tuple[str, bool]]
    right: str
    known: str


def command(*arguments: object) -> tuple[int, str]:
    """Exit code and all that a command prints; {out} in an argument is a folder to write in."""
    said = io.StringIO()
    with tempfile.TemporaryDirectory() as out:
        words = [str(word).replace("{out}", out) for word in arguments]
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code = cli.run(words)
        return code, said.getvalue().replace(out, "OUT")


def warned(read: Callable, *arguments: object):
    """What a reader returns, and its warnings as one text."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read(*arguments)
    return found, " ".join(str(one.message) for one in caught)


def raw_grey(folder: Path) -> tuple[str, bool]:
    photos = [read_photograph(path) for path in sorted(folder.glob("brightest_*.dng"))]
    greys = [float(photo.values[0, 0, 1]) for photo in photos]
    came = "grey " + ", ".join(f"{grey:.6f}" for grey in greys)
    return came, bool(np.allclose(greys, 0.3, rtol=0, atol=1e-6)) and len(greys) == 3


def raw_saturation(folder: Path) -> tuple[str, bool]:
    path = folder / "eos6d_like_saturates_at_13225_of_15490.dng"
    photo, said = warned(read_photograph, path)
    top = float(photo.values.max())
    clipped = ~photo.mask.all(axis=2)
    came = f"brightest {top:.4f}; {int(clipped.sum())} pixels masked, the sensor's level named"
    expected = (13225 - 2048) / (15490 - 2048)
    exact = np.array_equal(clipped, np.any(photo.values >= 0.999 * top, axis=2))
    return came, abs(top - expected) < 1e-6 and exact and "13225" in said


def colour_readings(folder: Path) -> tuple[str, bool]:
    (all_code, said), (grey_code, _) = (
        command("check", folder / name) for name in ("perfect24.csv", "perfect6.csv")
    )
    line = next(line for line in said.splitlines() if "colours" in line).split("chart A: ")[1]
    return f"no problem; {line}", (all_code, grey_code) == (0, 0)


def missing_ranges(folder: Path) -> tuple[str, bool]:
    shape = read_photograph(folder / "photo.png", "sRGB").values.shape[:2]
    distance, said = warned(read_range, folder / "depth.png", shape)
    came = f"{np.nanmin(distance):.2f}-{np.nanmax(distance):.2f} m; {said.split(': ')[-1]}"
    right = int(np.isnan(distance).sum()) == 7456 and np.nanmax(distance) < 65
    return came, bool(right) and "7456 of 38400" in said


def stated_curves(folder: Path) -> tuple[str, bool]:
    names = ("plain16", "srgbchunk16", "gama045_16")
    plain, srgb, gamma = (read_photograph(folder / f"{name}.png").values for name in names)
    _, said = warned(read_photograph, folder / "srgbchunk16.png", "linear")
    came = f"green {plain.mean(axis=(0, 1))[1]:.4f}, {srgb.mean(axis=(0, 1))[1]:.4f}, "
    came += f"{gamma.mean(axis=(0, 1))[1]:.4f}; a wish for linear is contradicted by name"
    right = np.allclose(gamma, plain ** (1 / 0.45455), atol=2e-5)
    right &= np.allclose(srgb, ((plain + 0.055) / 1.055) ** 2.4, atol=2e-5)
    return came, bool(right) and "contradicts" in said


def found_charts(folder: Path) -> tuple[str, bool]:
    came, right = [], True
    for path in sorted(folder.glob("*.png")):
        photo = read_photograph(path)
        charts = find_charts(photo)
        reading = read_chart(photo, charts[0], "ColorChecker24")
        came.append(f"{path.stem}: {len(charts)}, {reading.message().split(': ')[1]}")
        right &= len(charts) == 1 and bool(reading.kept.all()) and reading.agreement > 0.97
    return "; ".join(came), right


def largest_page(folder: Path) -> tuple[str, bool]:
    values = read_photograph(folder / "multipage16.tif").values
    return f"{values.shape[1]} x {values.shape[0]} pixels", values.shape == (64, 96, 3)


CASES = [
    Case(
        "Pictures",
        "raw files of one grey beside a pixel of 0.74, 0.76 and 0.90",
        "12-raw-scale-follows-content",
        raw_grey,
        "0.300000 in each",
        "(1300 - 100) / (4100 - 100) counts, as the files were made",
    ),
    Case(
        "Pictures",
        "raw file that saturates below its stated white level",
        "12-raw-scale-follows-content",
        raw_saturation,
        "0.8315, masked where it is reached",
        "(13225 - 2048) / (15490 - 2048) counts, as the file was made",
    ),
    Case(
        "Pictures",
        "readings of a ColorChecker, all patches and its greys alone",
        "13-check-of-colour-charts",
        colour_readings,
        "no problem with either",
        "the readings are linear, as they were made",
    ),
    Case(
        "Pictures",
        "16-bit range map with 65535 where nothing is known",
        "15-range-65535",
        missing_ranges,
        "7456 pixels missing, none at 65.535 m",
        "a count of 65535 in the file; the next lower value is 43.547 m",
    ),
    Case(
        "Pictures",
        "16-bit PNG that states nothing, sRGB, and a gamma of 0.45455",
        "17-sixteen-bit-display-curve",
        stated_curves,
        "as it is; by IEC 61966-2-1; to the power 2.2",
        "the three files hold the same numbers; the curves by the standards",
    ),
    Case(
        "Pictures",
        "ColorChecker in linear pictures without white balance",
        "19-find-in-a-linear-picture",
        found_charts,
        "found once in each, 24 of 24 patches",
        "seen by eye; with corners by hand 24 of 24 are read",
    ),
    Case(
        "Pictures",
        "TIFF of several pages, a preview first",
        "26-multipage-tiff",
        largest_page,
        "96 x 64 pixels",
        "the sizes of its pages",
    ),
]


def main() -> int:
    folder = data_folder("real_files", *sorted({case.folder for case in CASES}))
    jax.config.update("jax_enable_x64", True)
    lines, wrong = ["# Real files", "", "`python -m tests.acceptance.real_files FOLDER`"], 0
    for heading in dict.fromkeys(case.heading for case in CASES):
        lines += ["", f"## {heading}", "", "| file | what came | what is right | how it is known |"]
        lines += ["|---|---|---|---|"]
        for case in CASES:
            if case.heading == heading:
                came, right = case.run(folder / case.folder)
                came = came.replace(f"{folder}/", "").replace("|", "/")
                wrong += not right
                mark = "" if right else "NOT RIGHT: "
                lines.append(f"| {case.name} | {mark}{came} | {case.right} | {case.known} |")
    text = "\n".join(lines) + "\n"
    print(text)
    Path(__file__).with_suffix(".md").write_text(text)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
