"""Fits to photographs of boards of finite size, whose readings were walked, not predicted.

    python -m tests.acceptance.photo_boards [known | wrong | points]

Writes photo_boards_<part>.md.  The readings are those of `_walked_charts.py`: random walks with the
board in the scene, in front of open water and over sand, in three waters, for boards of 0.1-0.6 m
at 0.3-8 m.  Each scene is three ColorCheckers and open water in one photograph by a Nikon D850,
with arbitrary gains and 1 % noise, fitted as by `fit_photo` without any argument.

- "known": the boards' sizes as they are, to 5 %.
- "wrong": boards taken for 1.4 times as wide, their size given to within 35 %.
- "points": boards without size, as fits took them for before.
"""

import dataclasses
import sys
from pathlib import Path

import jax
import numpy as np

import oceaninv as oi
from fitting import Background, Board, Chart, Photo, fit_photos
from tests.acceptance import _walked_charts as walked
from tests.acceptance.photo_statistics import POINT

DRAWS, NOISE, SEED = 3, 0.01, 41
QUANTITIES = ("c_550", "Kd_490", "bb_550", "a_cdm_440")
SIZES = {"known": (1.0, 0.05), "wrong": (1.4, 0.35), "points": None}


def board_of(chart: walked.WalkedChart, size) -> Board:
    """The board as the fit takes it: (factor on its lengths, sd of their ln), or a point."""
    if size is None:
        return POINT
    factor, sd = size
    across, down = chart.half_width / 3, chart.half_height / 2
    patches = np.array(
        [
            # x grows to the left of a camera that looks along y.
            [(2.5 - j) * across, (i - 1.5) * down, chart.patch_half, chart.patch_half]
            for i in range(4)
            for j in range(6)
        ]
    )
    width, height = 2 * chart.half_width * factor, 2 * chart.half_height * factor
    return Board(width, height, sd, patches * factor, chart.reflectance, walked.BLACK)


def photographs(scene: walked.WalkedScene, size, rng) -> list[Photo]:
    """Noisy photographs of a scene."""
    response = oi.spectrum.camera_response("Nikon D850")
    weights = np.asarray(response.weights(scene.wavelength))
    spectra = np.concatenate([*(chart.radiance for chart in scene.charts), scene.background])
    exact = spectra @ weights.T
    made = []
    for _ in range(DRAWS):
        gains = np.exp(0.5 * rng.standard_normal(3))
        values = exact * gains * (1 + NOISE * rng.standard_normal(exact.shape))
        charts, start = [], 0
        for chart in scene.charts:
            part = values[start : start + len(chart.reflectance)]
            start += len(part)
            board = board_of(chart, size)
            charts.append(Chart(part, chart.reflectance, chart.distance, NOISE * part, board=board))
        water = [Background(values[start:], scene.zenith, NOISE * values[start:])]
        made.append(
            Photo(
                charts,
                water,
                depth=scene.depth,
                response=response,
                solar_zenith=scene.solar_zenith,
                azimuth=scene.azimuth,
            )
        )
    return made


@dataclasses.dataclass(frozen=True)
class Row:
    """Of one scene and way to take its boards: (draw, quantity) errors of ln, sd, whether the 95 %
    interval holds the truth; (draw,) reduced chi-square and whether the fit converged."""

    error: np.ndarray
    sd: np.ndarray
    covered: np.ndarray
    chi2: np.ndarray
    converged: np.ndarray


def fitted(scene: walked.WalkedScene, size, rng) -> Row:
    fits = fit_photos(photographs(scene, size, rng))
    truth = np.array([getattr(scene, name) for name in QUANTITIES])
    error, sd, covered = [], [], []
    for fit in fits:
        found = [fit.quantities[name] for name in QUANTITIES]
        error.append([np.log(float(q.value) / t) for q, t in zip(found, truth, strict=True)])
        sd.append([float(q.sd) for q in found])
        edges = [q.interval(0.95) for q in found]
        covered.append([low <= t <= high for (low, high), t in zip(edges, truth, strict=True)])
    chi2 = [float(fit.metadata["reduced_chi2"]) for fit in fits]
    return Row(
        np.array(error),
        np.array(sd),
        np.array(covered, bool),
        np.array(chi2),
        np.array([fit.converged for fit in fits]),
    )


def line(rows: list[Row]) -> list[str]:
    """Numbers of some scenes together."""
    error, sd, covered = (
        np.concatenate([getattr(row, name) for row in rows]) for name in ("error", "sd", "covered")
    )
    shares = [f"{share:.2f}" for share in covered.mean(axis=0)]
    biases = [f"{value:+.2f}" for value in np.median(error / sd, axis=0)]
    off = 100 * np.quantile(np.abs(np.expm1(error[:, 0])), 0.68)
    width = 100 * np.median(sd[:, 0])
    chi2 = np.median(np.concatenate([row.chi2 for row in rows]))
    done = np.mean(np.concatenate([row.converged for row in rows]))
    return [*shares, *biases, f"{off:.1f}", f"{width:.1f}", f"{chi2:.2f}", f"{done:.2f}"]


def name_of(scene: walked.WalkedScene) -> str:
    ranges = " ".join(f"{chart.distance:g}" for chart in scene.charts)
    width = 2 * scene.charts[0].half_width
    peak = "" if scene.peak == "model" else f", {scene.peak} peak"
    return f"{scene.water}, {scene.around}, {width:.2g} m at {ranges} m{peak}"


def table(size: str, rows: dict[str, Row], scenes: list[walked.WalkedScene]) -> str:
    heads = ["scenes", *(f"covers {name}" for name in QUANTITIES)]
    heads += [f"bias/sd {name}" for name in QUANTITIES]
    heads += ["error of c, % (68th percentile)", "sd of c, %", "chi2", "converged"]
    out = [
        f"# Photo fits of boards of finite size: {size}\n",
        f"`python -m tests.acceptance.photo_boards {size}`: {len(scenes)} walked scenes, {DRAWS} "
        f"draws of {100 * NOISE:g} % noise each.  Shares of 95 % intervals that hold the truth; "
        "median errors of the logarithm in standard deviations.\n",
        f"| {' | '.join(heads)} |",
        f"|{'---|' * len(heads)}",
    ]
    groups = {f"{water}, all": [s for s in scenes if s.water == water and s.peak == "model"]
              for water in walked.CONSTITUENTS}  # fmt: skip
    groups["all, another peak"] = [s for s in scenes if s.peak != "model"]
    groups |= {name_of(s): [s] for s in scenes}
    for name, members in groups.items():
        numbers = line([rows[name_of(scene)] for scene in members])
        out.append(f"| {name} | {' | '.join(numbers)} |")
    return "\n".join(out) + "\n"


def main(parts: list[str]) -> None:
    jax.config.update("jax_enable_x64", True)
    scenes = walked.load()
    for size in parts or SIZES:
        rows: dict[str, Row] = {}
        for i, scene in enumerate(scenes):
            rows[name_of(scene)] = fitted(scene, SIZES[size], np.random.default_rng([SEED, i]))
            print(size, name_of(scene), *line([rows[name_of(scene)]]), flush=True)
        text = table(size, rows, scenes)
        print(text)
        path = Path(__file__).with_name(f"photo_boards_{size}.md")
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
