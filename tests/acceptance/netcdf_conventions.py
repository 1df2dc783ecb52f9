"""Whether netCDF files of fits and archives follow the Climate and Forecast conventions.

    python -m tests.acceptance.netcdf_conventions

Needs the package compliance-checker.  Prints the table and writes netcdf_conventions.md beside this
file; a minute.  Both files are of made-up casts of three bands: the one that an archive writes and
the one that a single fit saves.  Ends with status 1 if a check of high priority fails.
"""

import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
from compliance_checker import suite  # pyright: ignore[reportMissingImports]

from fitting import Profile, fit_profile
from fitting.files.cast_file import Reading
from fitting.profile.archive import Task, fit_archive
from fitting.report.netcdf_file import save

BANDS = np.array([412.0, 490.0, 555.0])
CHECK = "cf:1.8"


def cast(seed: int) -> Profile:
    rng = np.random.default_rng(seed)
    depth = np.sort(rng.uniform(0.2, 20.0, 30))
    kd = np.exp(rng.uniform(np.log(0.05), np.log(0.3), 3))
    noise = 1 + 0.05 * rng.standard_normal((30, 3))
    return Profile(depth, BANDS, np.exp(-kd * depth[:, None]) * noise)


def write_csv(path: Path, profile: Profile) -> Path:
    table = np.column_stack([profile.depth, profile.Ed])
    rows = [",".join(f"{value:.9g}" for value in row) for row in table]
    names = ",".join(["depth_m", *(f"Ed_{band:g}" for band in profile.wavelength)])
    path.write_text("\n".join(["# Ed in W m-2 nm-1", names, *rows]) + "\n")
    return path


def main() -> int:
    checks = suite.CheckSuite()
    checks.load_all_available_checkers()
    lines = [
        "# Files against the Climate and Forecast conventions",
        "",
        f"`python -m tests.acceptance.netcdf_conventions`: compliance-checker "
        f"{version('compliance-checker')}, {CHECK}.",
        "",
        "| file | checks of high priority | failed | of lower priority | with remarks |",
        "|---|---|---|---|---|",
    ]
    failed = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = [write_csv(folder / f"cast{i}.csv", cast(i)) for i in range(2)]
        list(fit_archive(paths, Task(folder / "out", Reading())))
        save(folder / "fit.nc", fit_profile(cast(0)))
        files = {"archive": folder / "out" / "cast0.csv.kd.nc", "one fit": folder / "fit.nc"}
        for kind, path in files.items():
            scores, _ = checks.run_all(checks.load_dataset(str(path)), [CHECK], [])[CHECK]
            high = [score for score in scores if score.weight == 3]
            lower = [score for score in scores if score.weight < 3]
            wrong = [message for score in high for message in score.msgs]
            failed += wrong
            remarks = sum(bool(score.msgs) for score in lower)
            lines.append(f"| {kind} | {len(high)} | {len(wrong)} | {len(lower)} | {remarks} |")
    text = "\n".join([*lines, *failed]) + "\n"
    print(text)
    Path(__file__).with_suffix(".md").write_text(text)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
