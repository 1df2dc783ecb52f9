"""The photo fit on real readings: one frame developed twice, one grey patch at many depths.

    python -m tests.acceptance.photo_real FOLDER

FOLDER holds a frame of the Sea-thru data (Akkaynak & Treibitz 2019) as
seathru_3374_bluegreen.png and seathru_3374_red.png, its ranges seathru_depth_3374.exr, and
grey_patch_vs_depth.csv; none of them may be redistributed.
Prints tables and writes photo_real.md beside this file.

- One frame of four DGK charts at 4.7-9.8 m, developed with two white balances that differ by a
  full 3 x 3 matrix: each version fitted by itself, with the matrix unknown.  Patches by their
  corners, clipped ones dropped by the program.
- Readings of one neutral patch by one camera, 0.7-14.9 m deep: those down to 7.5 m are averaged in
  bins and fitted, those below are predicted.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from fitting import Background, Chart, Photo, fit_photo, read_photograph, read_range
from fitting.commands.main import quick_compilation
from fitting.core.least_squares import least_squares
from fitting.core.result import quantile
from fitting.images.chart_reading import read_chart
from fitting.photo.forward_model import predict
from fitting.photo.problem import prepare
from tests.acceptance._folder import data_folder

FILES = (
    "seathru_3374_bluegreen.png",
    "seathru_3374_red.png",
    "seathru_depth_3374.exr",
    "grey_patch_vs_depth.csv",
)
# Column and row of the corners of the patches, by eye.
CORNERS = {
    "A": [[387.5, 298], [424, 300], [422.5, 321], [385.5, 319.5]],
    "B": [[471.5, 290.5], [498.5, 294], [497.5, 309.5], [470.5, 306.5]],
    "C": [[356.5, 263.5], [379.5, 264.5], [378.5, 278.5], [355.5, 277]],
    "D": [[418.5, 256.5], [433.5, 257], [433.5, 267.5], [419, 266.5]],
}
ZENITH = {"A": 97.0, "B": 97.0, "C": 95.0, "D": 94.0}
WATER = [(245, 150, 305, 172, 90.0), (395, 154, 445, 168, 90.0)]
NOISE = 0.04
SHALLOW, BIN = 7.5, 1.5
# Spread (ln) that the fit allows the light on a chart.
LIGHT = 1.0
# Scatter of ln(R/G) and ln(B/G) about a smooth curve of depth.
SCATTER = np.array([0.036, 0.023])
# Each search takes seconds: of the readings below, in order of depth, every tenth is asked for.
EVERY = 10


def frame(folder: Path, version: str):
    """(photo, sentences) of one version of the frame."""
    picture = read_photograph(folder / f"seathru_3374_{version}.png", "linear")
    ranges = read_range(folder / "seathru_depth_3374.exr", picture.values.shape[:2])
    charts, said = [], []
    for name, corners in CORNERS.items():
        found = read_chart(picture, corners, "DGK18")
        column, row = np.round(found.outline.mean(axis=1)).astype(int).T
        distance = float(np.nanmedian(ranges[row, column]))
        charts.append(found.chart(distance, noise=NOISE, name=name, zenith=ZENITH[name]))
        clipped = ", ".join(str(i + 1) for i in np.flatnonzero(found.clipped)) or "none"
        said.append(f"{name} at {distance:.2f} m: clipped {clipped}")
    windows = [picture.values[y0 : y1 + 1, x0 : x1 + 1] for x0, y0, x1, y1, _ in WATER]
    values = np.stack([w.mean(axis=(0, 1)) for w in windows])
    water = Background(values, [w[4] for w in WATER], NOISE * values)
    photo = Photo(
        charts,
        [water],
        response=oi.spectrum.camera_response("Nikon D810"),
        depth=5.0,
        depth_sd=0.4,
        azimuth=180.0,
        source=f"frame 3374, {version}",
    )
    return photo, said


def two_versions(folder: Path) -> str:
    lines = ["## One frame, developed twice\n"]
    fits = {}
    for version in ("bluegreen", "red"):
        photo, said = frame(folder, version)
        fits[version] = fit_photo(photo, matrix=True)
        fit = fits[version]
        lines.append(
            f"- {version}: {'; '.join(said)}; {fit.result}, reduced chi2 "
            f"{fit.metadata['reduced_chi2']:.2f}, nearest Jerlov type "
            f"{fit.metadata['nearest_jerlov_type']}."
        )
    lines += ["", "| quantity | " + " | ".join(fits) + " | difference of ln / its sd | "
              "each value inside the other's 68 % |", "|---|---|---|---|---|"]  # fmt: skip
    for name in ("Kd_490", "c_550", "a_cdm_440", "bb_550"):
        one, two = (f.quantities[name] for f in fits.values())
        apart = float(np.log(one.value / two.value))
        cells = []
        for q in (one, two):
            low, high = q.interval(0.68)
            cells.append(f"{float(q.value):.4f} ({float(low):.4f}-{float(high):.4f})")
        inside = abs(apart) <= quantile(0.68) * min(float(one.sd), float(two.sd))
        share = apart / np.hypot(float(one.sd), float(two.sd))
        lines.append(
            f"| {name} | {cells[0]} | {cells[1]} | {share:+.2f} | {'yes' if inside else 'no'} |"
        )
    return "\n".join(lines)


def binned(folder: Path):
    """(values (bin, 3), depths) of the shallow readings, and the deep ones one by one."""
    table = np.loadtxt(folder / "grey_patch_vs_depth.csv", delimiter=",", comments="#")
    depth, values = table[:, 3], table[:, :3]
    rows = []
    for start in np.arange(0.0, SHALLOW, BIN):
        inside = (depth >= start) & (depth < start + BIN)
        if inside.any():
            # Brightness varies by an exposure that nobody wrote down: colour is what is averaged.
            colour = np.log(values[inside]) - np.log(values[inside, 1:2])
            rows.append((np.exp(colour.mean(axis=0)), depth[inside].mean(), inside.sum()))
    return rows, values[depth >= SHALLOW], depth[depth >= SHALLOW]


def one_patch(depth: float, values, count: float):
    """A photograph of the patch alone, close to the camera, its brightness unknown."""
    # Each channel's share of the scatter of the two ratios: green 1.4 %, red 3.3 %, blue 1.8 %.
    scatter = np.array([0.033, 0.014, 0.018]) / np.sqrt(count)
    values = np.asarray(values)[None]
    chart = Chart(values, [0.18], 0.5, np.hypot(scatter, 0.005)[None] * values, distance_sd=0.5)
    return Photo([chart], depth=depth, depth_sd=0.02, exposure=1.0, exposure_sd=1.0)


def grey_patch(folder: Path) -> str:
    shallow, seen, depth = binned(folder)
    photos = [one_patch(d, values, n) for values, d, n in shallow]
    fit = fit_photo(photos)
    # The deep ones in bins of depth for the prediction, which is smooth in it.
    edges = np.linspace(depth.min(), depth.max(), 9)
    deep = [one_patch(d, np.ones(3), 1.0) for d in edges]
    _, readings, sunlight = prepare(deep, oi.TwoStream())
    layout = fit.problem.layout

    count = len(fit.x)

    def colours(x):
        # A new frame's range and light on the patch are as unknown as those of the frames fitted.
        values, (away, share) = layout.values(x[:count]), jnp.exp(spreads * x[count:])
        rows = []
        for p, one in enumerate(readings):
            here = {**values, f"depth_{p}": jnp.asarray(edges[p]),
                    f"exposure_{p}": jnp.ones(()), f"chart_{p}_0": share,
                    f"range_{p}_0": away}  # fmt: skip
            row = jnp.log(predict(here, one, oi.TwoStream(), sunlight, p)[0])
            rows.append(jnp.stack([row[0] - row[1], row[2] - row[1]]))
        return jnp.stack(rows)

    def misfit(x, news):
        weights, target, sd = news
        off = jnp.einsum("ce,ec->c", weights, colours(x)) - target
        return jnp.concatenate([fit.problem.residual(x[:count]), x[count:], off / sd])

    spreads = jnp.asarray([deep[0].charts[0].distance_sd, LIGHT])
    start = jnp.concatenate([jnp.asarray(fit.x), jnp.zeros(2)])
    unit = jnp.concatenate([jnp.minimum(jnp.sqrt(jnp.diagonal(fit.covariance)), 2.0), jnp.ones(2)])

    def sums(news):
        found = least_squares(misfit, start, news, unit)
        return jnp.sum(found.residual**2), colours(found.x)

    # What a reading costs: the sum of squares of all readings with it, above the one without.  It
    # is chi-squared where the reading lies as the water, the camera and its own scatter let it.
    hats = np.stack([np.interp(depth, edges, row) for row in np.eye(len(edges))], axis=1)
    measured = np.log(seen[:, [0, 2]] / seen[:, 1:2])
    free, mean = 1e9, np.repeat(hats.mean(axis=0)[None], 2, axis=0)
    news = [(mean, np.zeros(2), np.full(2, free)),
            (mean, measured.mean(axis=0), SCATTER / np.sqrt(len(depth)))]  # fmt: skip
    order = np.argsort(depth)[EVERY // 2 :: EVERY]
    for k in range(2):
        for row, value in zip(hats[order], measured[order], strict=True):
            sd = np.where(np.arange(2) == k, SCATTER, free)
            news.append((np.repeat(row[None], 2, axis=0), value, sd))
    stacked = tuple(jnp.asarray(np.stack(one)) for one in zip(*news, strict=True))
    total, middle = jax.jit(lambda n: jax.lax.map(sums, n))(stacked)
    together, cost = float(total[1] - total[0]), np.asarray(total[2:] - total[0]).reshape(2, -1)
    lines = [
        "\n## One grey patch at many depths\n",
        f"{len(photos)} bins down to {SHALLOW:g} m fitted ({fit.result}, reduced chi2 "
        f"{fit.metadata['reduced_chi2']:.2f}), {len(depth)} readings below predicted; unknown "
        "camera, patch taken to be 0.5 m away within a factor of 1.6.  Intervals by the likelihood "
        f"ratio, at each {EVERY}th reading from the shallowest to the deepest.\n",
        "| colour | median error | median abs error | 68 % covers | 95 % covers |",
        "|---|---|---|---|---|",
    ]
    for k, name in enumerate(("ln(R/G)", "ln(B/G)")):
        error = measured[:, k] - hats @ np.asarray(middle[0])[:, k]
        cover = [np.mean(cost[k] <= quantile(level) ** 2) for level in (0.68, 0.95)]
        lines.append(
            f"| {name} | {np.median(error):+.3f} | {np.median(np.abs(error)):.3f} | "
            f"{cover[0]:.3f} | {cover[1]:.3f} |"
        )
    # All readings share the water and the patch's light: what they miss by is one error a colour.
    lines.append(
        "\nAll readings share the water and the light, and miss by one error a colour: the "
        f"means of both colours over all depths cost chi2 {together:.2f} for 2 (p "
        f"{np.exp(-0.5 * together):.2f})."
    )
    return "\n".join(lines)


def main():
    folder = data_folder("photo_real", *FILES)
    quick_compilation()
    jax.config.update("jax_enable_x64", True)
    report = "# Photo fit, real readings\n\n`python -m tests.acceptance.photo_real FOLDER`\n\n"
    for part in (two_versions, grey_patch):
        found = part(folder) + "\n"
        print(found, flush=True)
        report += found
    Path(__file__).with_name("photo_real.md").write_text(report)


if __name__ == "__main__":
    main()
