"""The few wavelengths from which cameras are best served: the numbers in spectrum.camera_bands.

    python -m tests.acceptance.band_nodes [cameras.csv]

Prints the table and writes band_nodes.md beside this file; minutes.

Least median + half the 95th percentile of CIEDE2000 against steps of 0.5 nm, by Nelder & Mead from
equal bands.  Cameras: of the csv those that `camera_bands` does not test on (of the cameras that
come with the project every other one).  Waters: 12 random bio-optical ones over a floor at 2-12 m,
to 650 nm six Jerlov types at random depths, too; 20 lines of sight each.
"""

import csv
import dataclasses
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import oceaninv as oi
from oceaninv.rendering.display import display_matrix
from tests.acceptance.camera_bands import SCENE, names_of, read_responses

jax.config.update("jax_enable_x64", True)

SPANS = ((400.0, 650.0), (400.0, 700.0))
COUNTS = (8, 12)
JERLOV = ("1C", "IA", "IB", "II", "I", "3C")


def cameras():
    """Responses that the table of `camera_bands` is not made of."""
    if len(sys.argv) < 2:
        return [oi.spectrum.camera_response(name) for name in oi.spectrum.camera_names()[::2]]
    with open(sys.argv[1], encoding="utf-8") as file:
        rows = list(csv.reader(line for line in file if not line.startswith("#")))[1:]
    tested = names_of(rows)
    return [r for name, r in read_responses(rows) if name not in tested]


def ratios(span, at) -> np.ndarray:
    """Radiance over daylight, (water, ray, at), from 2 nm steps."""
    rng = np.random.default_rng(99)
    wavelength = oi.spectrum.bands(round((span[1] - span[0]) / 2), *span)
    base = oi.load_scene(SCENE).scene
    day = oi.spectrum.daylight(wavelength)
    light = oi.Light(base.light.zenith, jnp.asarray(day), jnp.asarray(0.1 * day))
    waters = []
    if span[1] <= 650:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            waters += [oi.jerlov(kind, wavelength) for kind in JERLOV]
    model = oi.BioOpticalModel()
    for _ in range(12):
        amounts = 10 ** rng.uniform([-1.5, -2.0, -2.5], [0.7, -0.5, -1.0])
        waters.append(model.iops(oi.Constituents(*map(jnp.asarray, amounts)), wavelength))
    look = jax.jit(lambda scene, rays: oi.radiance(scene, rays).value)
    found = []
    for water in waters:
        depth = float(rng.uniform(2, 12))
        direction = rng.normal(size=(20, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        floor = oi.Floor(depth, jnp.full(wavelength.size, 0.3))
        scene = dataclasses.replace(base, water=water, light=light, floor=floor, objects=())
        seen = look(scene, oi.Rays([0.0, 0.0, depth - 1.5], jnp.asarray(direction)))
        found.append([np.interp(at, wavelength, row) for row in np.asarray(seen) / day])
    return np.array(found)


def errors(nodes, at, ratio, prepared) -> np.ndarray:
    """CIEDE2000 of all cameras, waters and rays."""
    import colour

    basis = oi.spectrum.spline_basis(nodes, at)
    coarse = np.array([[np.interp(nodes, at, row) for row in water] for water in ratio])
    differences = []
    for matrix, weights in prepared:
        pair = coarse @ (weights @ basis).T, ratio @ weights.T
        white = matrix @ weights.sum(axis=1) / np.pi
        scale = white[1] / np.max(pair[1] @ matrix.T[:, 1], axis=1)[:, None, None]
        labs = [
            colour.XYZ_to_Lab(
                np.maximum(scale * (p @ matrix.T), 0) / white[1], colour.XYZ_to_xy(white)
            )
            for p in pair
        ]
        differences.append(colour.delta_E(*labs, method="CIE 2000").ravel())
    return np.concatenate(differences)


def nodes_of(p, span) -> np.ndarray:
    """Nodes whose `band_edges` end at those of the span: first, last and all but their neighbours
    are free."""
    first, last, inner = p[0], p[1], np.sort(p[2:])
    low, high = span
    return np.concatenate([[first, 3 * first - 2 * low], inner, [3 * last - 2 * high, last]])


def fit(count: int, span) -> list[str]:
    """Rows of the table: equal bands and the nodes found."""
    at = np.arange(span[0] + 0.25, span[1], 0.5)
    day = 0.5 * oi.spectrum.daylight(at)
    prepared = []
    for response in cameras():
        values = [np.interp(at, response.samples, np.asarray(v)) for v in response.values]
        prepared.append((display_matrix(response), np.array(values) * day))
    ratio = ratios(span, at)

    def loss(p):
        nodes = nodes_of(p, span)
        if nodes[0] < span[0] or nodes[-1] > span[1] or np.min(np.diff(nodes)) < 5:
            return 99.0
        d = errors(nodes, at, ratio[:, ::3], prepared[::4])
        return np.median(d) + 0.5 * np.percentile(d, 95)

    equal = oi.spectrum.bands(count, *span)
    start = np.concatenate([[equal[0], equal[-1]], equal[2:-2]])
    step = (span[1] - span[0]) / count / 4 * np.where(np.arange(count - 2) % 2, -1, 1)
    simplex = np.vstack([start, start + np.diag(step)])
    options = {"maxfev": 250, "initial_simplex": simplex}
    best = nodes_of(minimize(loss, start, method="Nelder-Mead", options=options).x, span)
    rows = []
    for name, nodes in (("equal", equal), ("found", np.round(best, 1))):
        d = errors(nodes, at, ratio, prepared)
        shown = ", ".join(f"{x:.1f}" for x in nodes)
        rows.append(
            f"| {count} | {span[0]:g}-{span[1]:g} | {name} | {shown} | {np.median(d):.2f} "
            f"| {np.percentile(d, 95):.2f} |"
        )
        print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    given = " cameras.csv" if len(sys.argv) > 1 else ""
    lines = [
        "# Wavelengths that serve cameras best",
        "",
        f"`python -m tests.acceptance.band_nodes{given}`: CIEDE2000 against steps of 0.5 nm.",
        "",
        "| bands | nm | nodes | at, nm | median | 95 % |",
        "|---|---|---|---|---|---|",
    ]
    for span in SPANS:
        for count in COUNTS:
            lines += fit(count, span)
    Path(__file__).with_suffix(".md").write_text("\n".join(lines) + "\n")
