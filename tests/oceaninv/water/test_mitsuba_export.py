"""The export to Mitsuba: what stands in it, and that the renderer reads it."""

import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi


def _water():
    phases = (oi.phase.Isotropic(), oi.phase.HenyeyGreenstein(0.8), oi.phase.petzold())
    b = jnp.asarray([[0.1, 0.1], [0.3, 0.1], [0.2, 0.2]])
    return oi.IOPs([500.0, 600.0], jnp.asarray([0.1, 0.2]), b, phases)


def _numbers(text):
    return np.array([float(x) for x in text.split(",")])


def test_medium():
    water = _water()
    medium = oi.mitsuba.mitsuba_medium(water)
    np.testing.assert_allclose(_numbers(medium["sigma_t"]["values"]), water.c, rtol=1e-5)
    np.testing.assert_allclose(_numbers(medium["albedo"]["values"]), water.albedo, rtol=1e-5)
    # Shares of 0.2, 0.4 and 0.4, nested.
    outer, inner = medium["phase"], medium["phase"]["phase_0"]
    np.testing.assert_allclose([outer["weight"], inner["weight"]], [0.4, 2 / 3])
    assert inner["phase_0"] == {"type": "isotropic"}
    np.testing.assert_allclose(inner["phase_1"]["g"], 0.8)
    np.testing.assert_allclose(outer["phase_1"]["g"], 0.924, atol=1e-3)


def test_renderer_reads_it():
    """Both forms load, and forward is forward."""
    mi = pytest.importorskip("mitsuba")
    if "scalar_spectral" not in mi.variants():
        pytest.skip("this Mitsuba has no scalar_spectral variant")
    mi.set_variant("scalar_spectral")
    mi.load_dict(oi.mitsuba.mitsuba_medium(_water(), tabulated=True, angles=101))
    text = oi.mitsuba.mitsuba_xml(_water())
    mi.load_string(f'<scene version="3.0.0">{text}</scene>')
    alone = oi.IOPs([500.0, 600.0], jnp.ones(2), jnp.ones(2), oi.phase.HenyeyGreenstein(0.5))
    table = oi.mitsuba.mitsuba_medium(alone, tabulated=True)["phase"]
    exact = oi.mitsuba.mitsuba_medium(alone)["phase"]
    # HG's own class is exact already; a table of the same function must agree.
    shapes = [mi.load_dict(p) for p in (table, exact)]
    interaction = mi.MediumInteraction3f()
    interaction.wi = mi.Vector3f(0.0, 0.0, 1.0)
    context = mi.PhaseFunctionContext()
    for cosine in (-0.9, 0.0, 0.9):
        out = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0.0, float(cosine))
        found = [float(np.ravel(s.eval_pdf(context, interaction, out)[1])[0]) for s in shapes]
        np.testing.assert_allclose(found[0], found[1], rtol=1e-3)


def test_refusals():
    clear = oi.IOPs([500.0, 600.0], jnp.ones(2), jnp.zeros(2), oi.phase.Isotropic())
    with pytest.raises(ValueError, match="does not scatter"):
        oi.mitsuba.mitsuba_medium(clear)
