"""Readings of colour charts of finite size under water, by random walks with the board in them.

    python -m tests.acceptance._walked_charts

Writes tests/reference/walked_charts.npz, which `load` reads (about 20 minutes of one core, with
numba: pip install "oceaninv[bench]").  With `check` after its name it compares readings with
`oceaninv.MonteCarlo` instead.

A ColorChecker (24 square patches on a black board) stands upright and faces the camera, which
looks horizontally, at right angles to the sun, along the board's axis.  The light, the water and
the bands are those of a photo fit: daylight, direct only, sun at 40 degrees above a flat surface,
`fitting.water_model.unknowns.water_iops` at the centres of the nuisances.  The board is a sheet
without thickness, edge-on to the sun, whose back has the board's own reflectance.  Around it:

- "open": water without end;
- "sand": a floor 1.5 m below the board's axis.

How a reading is computed: `tests/acceptance/_chart_walks.py`.  No formula for image-forming light
takes part.
"""

import dataclasses
import math
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import oceaninv as oi
from fitting.images.chart_targets import target
from fitting.observations.photo import WAVELENGTH
from fitting.water_model.quantities import MARKS, kd_to_ten_percent
from fitting.water_model.unknowns import constituents, shape_nuisances, water_iops

PATH = Path(__file__).parents[1] / "reference/walked_charts.npz"
SEED = 20262
SUN = 40.0
HEIGHT, WIDTH = 0.204, 0.289  # of a ColorChecker, m
PATCH = 0.42  # half-size of a patch over the distance between rows or columns
BLACK = 0.04  # reflectance of the board between the patches, and of its back
FLOOR_BELOW = 1.5  # m below the board
ERROR = 3e-3  # relative standard error at which walks end
CONSTITUENTS = {
    "clear": (0.2, 0.03, 0.01),
    "coastal": (1.5, 0.15, 0.08),
    "turbid": (5.0, 0.5, 0.4),
}


class Setting(NamedTuple):
    """One scene: `peak` of the particles' phase functions, "model" or "petzold" ("smooth" for
    `check` alone); ranges and width of the boards in metres; `around`: "open" or "sand"."""

    water: str
    peak: str = "model"
    ranges: tuple[float, float, float] = (0.5, 1.0, 2.0)
    width: float = WIDTH
    depth: float = 5.0
    around: str = "open"


SETTINGS = (
    *(Setting(water) for water in CONSTITUENTS),
    Setting("clear", ranges=(0.5, 3.0, 8.0), depth=8.0),
    Setting("coastal", ranges=(0.5, 3.0, 8.0)),
    Setting("turbid", ranges=(0.3, 0.7, 1.4)),
    Setting("clear", width=0.1),
    Setting("coastal", width=0.6),
    Setting("turbid", width=0.1),
    *(Setting(water, around="sand") for water in CONSTITUENTS),
    *(Setting(water, peak="petzold") for water in CONSTITUENTS),
)


@dataclasses.dataclass(frozen=True)
class WalkedChart:
    """The readings of one board.

    - `distance`: m along the board's axis; `depth`: m, of camera and board.
    - `half_height`, `half_width`: of the board, m; `patch_half`: half the side of a patch, m.
    - `reflectance`, `radiance`, `stderr`: (patch, wl), patches in reading order, from the camera
      towards each patch's centre; radiance per sr for daylight of 1 at 560 nm.
    """

    distance: float
    depth: float
    half_height: float
    half_width: float
    patch_half: float
    reflectance: np.ndarray
    radiance: np.ndarray
    stderr: np.ndarray


@dataclasses.dataclass(frozen=True)
class WalkedScene:
    """One water with three boards, each alone in the water, and what is behind them.

    - `water`, `peak`, `around`: see `Setting`; `chlorophyll` (mg/m3), `cdom` (1/m at 440 nm),
      `detritus` (1/m at 400 nm).
    - `b`, `c`, `bb`: (wl) 1/m; `Kd_490`: 1/m, from the surface to 10 % light; `a_cdm_440`: 1/m;
      `c_550`, `bb_550`: 1/m.
    - `background`: (direction, wl) radiance of the water without a board along a horizontal line at
      right angles to the sun, `zenith` 90.
    - `background_beside`: (1, wl) the mean of two horizontal lines left and right of the farthest
      board, `beside_angle` degrees off its axis.  `_stderr`: of either.
    - `board_reflectance`: of the board between the patches.
    """

    water: str
    peak: str
    around: str
    chlorophyll: float
    cdom: float
    detritus: float
    depth: float
    solar_zenith: float
    azimuth: float
    zenith: tuple[float, ...]
    wavelength: np.ndarray
    b: np.ndarray
    c: np.ndarray
    bb: np.ndarray
    Kd_490: float
    a_cdm_440: float
    c_550: float
    bb_550: float
    board_reflectance: float
    charts: tuple[WalkedChart, ...]
    background: np.ndarray
    background_stderr: np.ndarray
    background_beside: np.ndarray
    background_beside_stderr: np.ndarray
    beside_angle: float


def load(path: Path = PATH) -> list[WalkedScene]:
    """The scenes of `SETTINGS`, in their order."""
    with np.load(path) as file:
        data = {name: file[name] for name in file.files}
    reflectance = target("ColorChecker24").reflectance
    scenes = []
    for i, setting in enumerate(SETTINGS):
        charts = []
        for k, distance in enumerate(setting.ranges):
            board = Board.of(setting, distance)
            charts.append(
                WalkedChart(
                    distance,
                    setting.depth,
                    board.half_height,
                    board.half_width,
                    board.patch_half,
                    reflectance,
                    data["radiance"][i, k].astype(float),
                    data["stderr"][i, k].astype(float),
                )
            )
        rows = {name: data[name][i].astype(float) for name in ("b", "c", "bb")}
        scalars = {name: float(data[name][i]) for name in SCALARS}
        backgrounds = {name: data[name][i].astype(float)[None] for name in BACKGROUNDS}
        scenes.append(
            WalkedScene(
                **dict(zip(AMOUNTS, CONSTITUENTS[setting.water], strict=True)),
                **rows,
                **scalars,
                **backgrounds,
                water=setting.water,
                peak=setting.peak,
                around=setting.around,
                depth=setting.depth,
                solar_zenith=SUN,
                azimuth=90.0,
                zenith=(90.0,),
                wavelength=WAVELENGTH,
                board_reflectance=BLACK,
                charts=tuple(charts),
                beside_angle=beside(setting),
            )
        )
    return scenes


AMOUNTS = ("chlorophyll", "cdom", "detritus")
SCALARS = ("Kd_490", "a_cdm_440", "c_550", "bb_550")
BACKGROUNDS = (
    "background",
    "background_stderr",
    "background_beside",
    "background_beside_stderr",
)


def beside(setting: Setting) -> float:
    """Angle (degrees) off the board's axis at which the water beside the farthest board is read."""
    return 2.0 + 1.5 * math.degrees(math.atan(setting.width / 2 / setting.ranges[-1]))


class Board(NamedTuple):
    """A board at y = `distance`, centred at x = 0 and at its depth; reflectances (patch + 1, wl),
    the last that of the board."""

    distance: float
    depth: float
    half_width: float
    half_height: float
    reflectance: np.ndarray

    @classmethod
    def of(cls, setting: Setting, distance: float) -> "Board":
        """The ColorChecker of a setting at one of its ranges."""
        colours = target("ColorChecker24").reflectance
        half = setting.width / 2
        everything = np.concatenate([colours, np.full((1, colours.shape[1]), BLACK)])
        return cls(distance, setting.depth, half, half * HEIGHT / WIDTH, everything)

    @property
    def steps(self) -> tuple[float, float]:
        """Distances between the centres of columns and of rows, m."""
        return self.half_width / 3, self.half_height / 2

    @property
    def patch_half(self) -> float:
        return PATCH * min(self.steps)

    def centres(self) -> np.ndarray:
        """(patch, 3) in reading order."""
        across, down = self.steps
        return np.array(
            [
                [(j - 2.5) * across, self.distance, self.depth + (i - 1.5) * down]
                for i in range(4)
                for j in range(6)
            ]
        )


def petzold_like(ratio: float) -> oi.phase.Tabulated:
    """Petzold's function, its values beyond 30 degrees multiplied so that bb/b is `ratio`: by a
    power of one factor that rises evenly with the angle to 1 at 90 degrees."""
    table = oi.phase.petzold()
    angle, values = np.asarray(table.angle_deg), np.exp(np.asarray(table.log_values))
    power = np.clip((angle - 30) / 60, 0, 1)

    def made(log_factor):
        return oi.phase.Tabulated(angle, jnp.asarray(values * np.exp(log_factor * power)))

    log_factor = brentq(lambda v: float(made(v).backscatter_ratio) - ratio, -4.0, 4.0, xtol=1e-6)
    return made(log_factor)


def water(setting: Setting, wavelength=WAVELENGTH) -> oi.IOPs:
    """The water of a fit at the centres of its nuisances.  With the peak "petzold", both shapes of
    particles, of bb/b 0.004 and 0.05, give way to `petzold_like` of the same bb/b: b and bb
    stay, the forward peak is Petzold's.  With "smooth" both are Henyey-Greenstein's, g = 0.9."""
    values = {p.name: jnp.asarray(p.centre) for p in (*constituents(), *shape_nuisances())}
    for name, amount in zip(AMOUNTS, CONSTITUENTS[setting.water], strict=True):
        values[name] = jnp.asarray(amount)
    made = water_iops(values, wavelength)
    if setting.peak == "model":
        return made
    pure, *particles = made.phases
    if setting.peak == "smooth":
        new = [oi.phase.HenyeyGreenstein(0.9) for _ in particles]
    else:
        new = [petzold_like(float(phase.backscatter_ratio)) for phase in particles]
    phases = (pure, *new)
    return oi.IOPs(
        wavelength,
        made.a_components,
        made.b_components,
        phases,
        made.absorbers,
        made.scatterers,
    )


def quantities(setting: Setting) -> dict[str, np.ndarray]:
    """What a fit should find: see `WalkedScene`."""
    grid = np.union1d(WAVELENGTH, MARKS)
    iops = water(setting, grid)
    own, marks = np.searchsorted(grid, WAVELENGTH), np.searchsorted(grid, MARKS)
    kd = kd_to_ten_percent(iops, jnp.asarray(SUN), oi.PlaneParallel(16))
    row = dict(zip(iops.absorbers, iops.a_components, strict=True))
    found = {name: np.asarray(getattr(iops, name)) for name in ("b", "c", "bb")}
    spectra = {name: value[own] for name, value in found.items()}
    return spectra | {
        "Kd_490": np.asarray(kd)[marks[1]],
        "a_cdm_440": np.asarray(row["cdom"] + row["detritus"])[marks[0]],
        "c_550": found["c"][marks[2]],
        "bb_550": found["bb"][marks[2]],
    }


def walked(index: int) -> dict[str, np.ndarray]:
    """All numbers of one setting."""
    from tests.acceptance import _chart_walks as walks

    setting, rng = SETTINGS[index], np.random.default_rng([SEED, index])
    light = walks.light_of(setting.water, setting.peak, setting.depth, setting.around)
    medium = walks.medium_of(water(setting))
    boards = [Board.of(setting, r) for r in setting.ranges]
    found = dict(quantities(setting))
    rows = [walks.readings(setting, light, medium, board, rng, ERROR) for board in boards]
    found["radiance"] = np.stack([row[0] for row in rows])
    found["stderr"] = np.stack([row[1] for row in rows])
    off = math.radians(beside(setting))
    views = {"background": (None, [0.0]), "background_beside": (boards[-1], [-off, off])}
    for name, (board, angles) in views.items():
        value, error = walks.background(setting, light, medium, board, angles, rng, ERROR)
        found[name], found[f"{name}_stderr"] = value, error
    worst = [f"{100 * np.max(row[1] / row[0]):.2f} % ({row[2]} walks)" for row in rows]
    light_error = f"L {light.residual.max():.3f}, E {light.irradiance_error.max():.4f};"
    print(index, *setting, light_error, *worst, flush=True)
    return found


def check(paths: int = 2**18, bands=(2, 5, 8, 11)):
    """Readings by both methods of a board at 1 m in coastal water, black but for one patch.

    The phase functions are Henyey-Greenstein's: of a Fournier-Forand peak, MonteCarlo draws the
    scattering from the sun within 0.1 degrees, a tenth of all, too rarely to state its error.
    """
    from tests.acceptance import _chart_walks as walks

    jax.config.update("jax_enable_x64", True)
    bright, patches = 9, (9, 10, 18)

    def box(centre, half, reflectance):
        spectrum = jnp.full(len(WAVELENGTH), reflectance)
        return oi.Box(np.subtract(centre, half), np.add(centre, half), spectrum)

    print("around, patch, wavelength, walks / MonteCarlo, its standard error")
    for around in ("open", "sand"):
        setting = Setting("coastal", "smooth", around=around)
        colours = np.full((25, len(WAVELENGTH)), BLACK)
        colours[bright] = 0.9
        board = Board.of(setting, 1.0)._replace(reflectance=colours)
        light = walks.light_of(setting.water, setting.peak, setting.depth, around)
        medium, rng = walks.medium_of(water(setting)), np.random.default_rng([SEED, 99])
        value, error, _ = walks.readings(setting, light, medium, board, rng, ERROR)
        eye = np.array([0.0, 0.0, setting.depth])
        lines = board.centres()[list(patches)] - eye
        lines = lines / np.linalg.norm(lines, axis=1)[:, None]
        # The patch stands out by half a millimetre.
        thin, middle = 2.5e-4, [0.0, board.distance + 5e-4, board.depth]
        things = [
            box(board.centres()[bright], [board.patch_half, thin, board.patch_half], 0.9),
            box(middle, [board.half_width, thin, board.half_height], BLACK),
        ]
        plain = walks.scene_of(setting)
        scene = oi.Scene(plain.water, plain.light, plain.surface, plain.floor, tuple(things))
        rays = oi.Rays(jnp.asarray(np.tile(eye, (len(lines), 1))), jnp.asarray(lines))
        other = oi.MonteCarlo(paths, 48).radiance(scene, rays, jax.random.key(1))
        for i, patch in enumerate(patches):
            for band in bands:
                truth, spread = float(other.value[i, band]), float(other.stderr[i, band])
                spread = math.hypot(spread, error[patch, band]) / truth
                ratio = value[patch, band] / truth
                name = f"{around}, {patch}, {WAVELENGTH[band]:.0f}"
                print(f"{name}, {ratio:.4f}, {spread:.4f}", flush=True)


def main():
    jax.config.update("jax_enable_x64", True)
    write([walked(i) for i in range(len(SETTINGS))])


def write(rows: list[dict[str, np.ndarray]]) -> None:
    """The file, of what `walked` gives for every setting."""
    stacked = {name: np.stack([row[name] for row in rows]).astype(np.float32) for name in rows[0]}
    np.savez_compressed(PATH, allow_pickle=False, **stacked)


if __name__ == "__main__":
    check() if sys.argv[1:] == ["check"] else main()
