"""Whether Mitsuba 3 loads what `oceaninv.mitsuba` exports, and evaluates the same phase function.

    python -m tests.acceptance.mitsuba_export

Needs the package mitsuba.  Prints the table and writes mitsuba_export.md beside this file; seconds.
A dictionary and an XML text of three mixed phase functions are loaded in the variant
scalar_spectral.  Then a tabulated Henyey-Greenstein function is compared with Mitsuba's own.
"""

from pathlib import Path

import jax.numpy as jnp
import mitsuba as mi  # pyright: ignore[reportMissingImports]
import numpy as np

import oceaninv as oi

COSINES = (-0.9, 0.0, 0.9)


def mixture() -> oi.IOPs:
    phases = (oi.phase.Isotropic(), oi.phase.HenyeyGreenstein(0.8), oi.phase.petzold())
    b = jnp.asarray([[0.1, 0.1], [0.3, 0.1], [0.2, 0.2]])
    return oi.IOPs([500.0, 600.0], jnp.asarray([0.1, 0.2]), b, phases)


def densities() -> np.ndarray:
    """(cosine, 2) 1/sr, as Mitsuba evaluates them: tabulated by us, its own Henyey-Greenstein."""
    water = oi.IOPs([500.0, 600.0], jnp.ones(2), jnp.ones(2), oi.phase.HenyeyGreenstein(0.5))
    media = [oi.mitsuba.mitsuba_medium(water, tabulated=tabulated) for tabulated in (True, False)]
    shapes = [mi.load_dict(medium["phase"]) for medium in media]
    interaction = mi.MediumInteraction3f()
    interaction.wi = mi.Vector3f(0.0, 0.0, 1.0)
    context = mi.PhaseFunctionContext()
    rows = []
    for cosine in COSINES:
        out = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0.0, float(cosine))
        found = [np.ravel(shape.eval_pdf(context, interaction, out)[1])[0] for shape in shapes]
        rows.append([float(value) for value in found])
    return np.array(rows)


def main() -> None:
    mi.set_variant("scalar_spectral")
    mi.load_dict(oi.mitsuba.mitsuba_medium(mixture(), tabulated=True, angles=101))
    mi.load_string(f'<scene version="3.0.0">{oi.mitsuba.mitsuba_xml(mixture())}</scene>')
    table = densities()
    lines = [
        "# Mitsuba loads the export",
        "",
        f"`python -m tests.acceptance.mitsuba_export`: Mitsuba {mi.__version__}, scalar_spectral;",
        "dictionary and XML of three mixed phase functions load. Henyey-Greenstein, g = 0.5:",
        "",
        "| cosine | our table, 1/sr | Mitsuba's own, 1/sr | relative difference |",
        "|---|---|---|---|",
    ]
    for cosine, (ours, own) in zip(COSINES, table, strict=True):
        lines.append(f"| {cosine:g} | {ours:.6f} | {own:.6f} | {ours / own - 1:+.1e} |")
    np.testing.assert_allclose(table[:, 0], table[:, 1], rtol=1e-3)
    text = "\n".join(lines) + "\n"
    print(text)
    Path(__file__).with_suffix(".md").write_text(text)


if __name__ == "__main__":
    main()
