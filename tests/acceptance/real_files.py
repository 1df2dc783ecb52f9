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

from fitting import fit_profile, read_photograph, read_range
from fitting.commands import main as cli
from fitting.files.cast_file import Reading, raw_casts, read_cast
from fitting.files.irradiance_units import depth_kind, irradiance_factor
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


def shown(fit, name: str = "Kd") -> str:
    """Values of a quantity with their 95 % intervals."""
    quantity = fit.quantities[name]
    low, high = quantity.interval(0.95, fit.dof)
    rows = zip(quantity.value, low, high, strict=True)
    return "; ".join(f"{v:.3g} ({a:.3g}-{b:.3g})" for v, a, b in rows)


def counted(profile) -> str:
    return "".join(f"; {count} {reason}" for reason, count in profile.counts.items())


def beyond_tables(folder: Path) -> tuple[str, bool]:
    came, right = [], True
    for path in sorted(folder.glob("*.csv")):
        code, said = command("fit-profile", path, "-o", "{out}/x")
        left = [line for line in said.splitlines() if "fitted without" in line]
        came.append(f"{path.stem}: {left[0].split(':')[0] if left else 'all bands'}")
        right &= code == 0 and "wrote" in said and "chlorophyll" in said
    return "; ".join(came), right


def raw_export(folder: Path) -> tuple[str, bool]:
    profile = read_cast(next(folder.glob("*.csv")))
    fit = fit_profile(profile)
    kd = fit.quantities["Kd"].value
    came = f"{len(kd)} bands, Kd {kd.max():.3g} at 765 nm to {kd.min():.3g}{counted(profile)}"
    # In the red pure water itself absorbs: 2.7 /m at 765 nm.
    return came, len(kd) == 19 and 2.5 < kd[-1] < 5.0 and bool(np.all(kd > 0.05))


def shaded_upcast(folder: Path) -> tuple[str, bool]:
    profile = read_cast(folder / "synthetic_sibling.csv")
    fit = fit_profile(profile)
    low, high = fit.quantities["Kd"].interval(0.95, fit.dof)
    truth = np.array([1.37, 0.85, 0.51, 0.83])
    return shown(fit) + counted(profile), bool(np.all((low < truth) & (truth < high)))


def down_and_up(folder: Path) -> tuple[str, bool]:
    came, right = [], True
    for name in ("kinneret_026", "singapore_004"):
        whole, down, up = (
            fit_profile(read_cast(folder / f"{name}{part}.csv")) for part in ("", "_down", "_up")
        )
        kd, halves = whole.quantities["Kd"], [f.quantities["Kd"] for f in (down, up)]
        came.append(f"{name}: both {shown(whole)}")
        for half in halves:
            apart = np.abs(np.log(kd.value / half.value)) / np.hypot(kd.sd, half.sd)
            right &= bool(np.all(apart < 3.0))
        right &= bool(np.all(kd.sd > 0.01))
    return "; ".join(came), right


def float_files(folder: Path) -> tuple[str, bool]:
    came, right = [], True
    for number in ("038", "059"):
        ends = {}
        for kind in "BS":
            fit = fit_profile(read_cast(folder / f"{kind}R6903247_{number}.nc"))
            ends[kind] = fit.quantities["Kd"].interval(0.95, fit.dof)
            par = float(fit.quantities["PAR_0"].value)
            came.append(f"{kind} {number}: Kd {shown(fit)}, PAR(0-) {par:.0f}")
            right &= par < 2600.0
        overlap = (ends["B"][0] < ends["S"][1]) & (ends["S"][0] < ends["B"][1])
        right &= bool(np.all(overlap))
    return "; ".join(came), right


def neighbouring_bands(folder: Path) -> tuple[str, bool]:
    apart, same = (read_cast(folder / f"hp_ed_lu{name}.csv") for name in ("", "_same"))
    one, other = (fit_profile(cast).quantities["KLu"].value for cast in (apart, same))
    return f"KLu of {np.isfinite(one).sum()} bands", bool(np.allclose(one, other, rtol=1e-9))


def photons(folder: Path) -> tuple[str, bool]:
    came, right = [], True
    for name in ("prr_edfirst", "prr_esfirst"):
        fit = fit_profile(read_cast(folder / f"{name}.sb"))
        par, deep = fit.quantities["PAR_0"], float(fit.quantities["Z_eu"].value)
        came.append(f"{float(par.value):.0f} {par.unit}, Z_eu {deep:.0f} m")
        right &= 1500 < par.value < 1700 and 60 < deep < 130
    return "; ".join(came), bool(right)


def fill_values(folder: Path) -> tuple[str, bool]:
    came, right = [], True
    for name in ("one_1e20", "one_9.96921e36", "deep_99999"):
        profile = read_cast(folder / f"{name}.csv")
        fit = fit_profile(profile)
        kd, (low, high) = fit.quantities["Kd"], fit.interval("Kd_490")
        came.append(f"{name}: {kd.value[2]:.4f} ({low:.4f}-{high:.4f}){counted(profile)}")
        right &= abs(kd.value[2] - 0.0433) < 5e-4
    return "; ".join(came), bool(right)


def spellings(folder: Path) -> tuple[str, bool]:
    text = (folder / "list.py").read_text(encoding="utf-8")
    listed = text[text.index("[") + 1 : text.index("]:")].split('","')
    units = [unit.strip('"').encode().decode("unicode_escape") if "\\u" in unit
             else unit.strip('"') for unit in listed]  # fmt: skip
    refused = [unit for unit in units if irradiance_factor(unit) is None]
    expected = {"W m-3", "W/m^3", "uE/m^2/s", "umol photons m-2 s-1 nm-1", "quanta/cm^2/s/nm",
                "W m-2 nm", "MW m-2 nm-1"}  # fmt: skip
    depths = [depth_kind(u) for u in ("Meters (m)", "DECIBAR", "cm", "kPa")]
    came = f"{len(units) - len(refused)} of {len(units)} known; refused: {', '.join(refused)}"
    return came, set(refused) == expected and depths == ["m", "dbar", None, None]


def one_sensor(folder: Path) -> tuple[str, bool]:
    said = []
    for path in sorted(folder.glob("*.tsv")):
        code, text = command("fit-profile", path, "-o", "{out}/x")
        said.append(code == 3 and "as SatCon writes it" in text)
    return f"refused by name, {sum(said)} of {len(said)} files", all(said)


def renamed_columns(folder: Path) -> tuple[str, bool]:
    path = next(folder.glob("*.csv"))
    names = path.read_text(encoding="utf-8").splitlines()[0].split(",")
    column = next(name for name in names if name.startswith("EdZ490"))
    reading = Reading(columns={"depth": "EdZDepth (m)", "Ed_490": column})
    raw = raw_casts(path, reading)[0]
    return f"Ed_490 in {raw.units['Ed_490']}", raw.units["Ed_490"] == "µW/(cm² nm)"


def _cast(name, folder, run, right, known) -> Case:
    return Case("Casts", name, folder, run, right, known)


CASES = [
    _cast(
        "bands beyond the tables, by the default command",
        "01-bands-beyond-table",
        beyond_tables,
        "Kd and constituents, bands outside 380-780 nm named",
        "the range of the tables",
    ),
    _cast(
        "C-OPS raw export",
        "02-cops-raw-export",
        raw_export,
        "19 bands; Kd above pure water's in the red",
        "columns of the file; IOCCG 2018",
    ),
    _cast(
        "upcast that ends in the boat's shade",
        "03-upcast-in-shade",
        shaded_upcast,
        "1.37, 0.85, 0.51, 0.83 within the intervals",
        "made with these",
    ),
    _cast(
        "down- and upcast in one file",
        "04-up-and-down-together",
        down_and_up,
        "agrees with either half within 3 sd, sd above 1 %",
        "each half alone",
    ),
    _cast(
        "B files of a float beside its S files",
        "05-argo-B-file",
        float_files,
        "intervals overlap; PAR(0-) below 2600",
        "one cast thinned in two ways; the sun",
    ),
    _cast(
        "Ed and Lu at centres that differ by tenths of nm",
        "06-lu-bands-differ",
        neighbouring_bands,
        "the same as with equal centres",
        "the same numbers, renamed",
    ),
    _cast(
        "PAR in uE cm-2 s-1, above and below the water",
        "08-par-of-a-PRR",
        photons,
        "some 1600 umol m-2 s-1, whichever comes first",
        "its first sample, 0.16 uE cm-2 s-1",
    ),
    _cast("fill values among readings", "09-fill-values", fill_values, "0.0433", "the clean cast"),
    _cast(
        "spellings of units",
        "20-unit-spellings",
        spellings,
        "all but seven, which are no irradiance or say two things",
        "read by eye",
    ),
    _cast(
        "tables of single sensors",
        "22-satcon-tsv",
        one_sensor,
        "refused by their name",
        "they hold no depth",
    ),
    _cast(
        "renamed columns",
        "23-columns-drops-unit",
        renamed_columns,
        "µW/(cm² nm)",
        "the column's name",
    ),
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
