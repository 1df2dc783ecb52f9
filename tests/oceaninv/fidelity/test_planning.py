"""The choice of a model: what is dropped does not matter, and what is chosen follows the tolerance.

That the predicted errors hold on random scenes is measured by tests/acceptance/plan.py.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from oceaninv.fidelity import error_model, planning, scene_terms

WAVELENGTH = np.linspace(410.0, 690.0, 15)


@functools.cache
def _water(chlorophyll=1.0):
    return oi.BioOpticalModel().iops(
        oi.Constituents(chlorophyll, cdom=0.1, detritus=0.05), WAVELENGTH
    )


def _scene(floor=None, sky=None, water=None, **more):
    one = jnp.ones(len(WAVELENGTH))
    ground = None if floor is None else oi.Floor(floor, 0.3 * one)
    light = oi.Light(40.0, one, None if sky is None else sky * one)
    return oi.Scene(water or _water(), light, oi.FlatSurface(), ground, **more)


def _flops(stage):
    cost = stage.cost_analysis()
    assert cost is not None
    return cost["flops"]


def _ed(scene, depth=5.0):
    return np.asarray(oi.irradiance(scene, depth).Ed.value)


def _rank(quantity, transport):
    return [planning.model_label(t) for t in planning.CANDIDATES[quantity]].index(
        planning.model_label(transport)
    )


@pytest.mark.parametrize("quantity", planning.QUANTITIES)
def test_a_smaller_tolerance_is_never_cheaper(quantity):
    ranks = [
        _rank(quantity, oi.plan(_scene(), tolerance, quantity, depth=3.0).transport)
        for tolerance in (0.6, 0.1, 0.03, 0.01, 0.002)
    ]
    assert ranks == sorted(ranks)
    assert ranks[0] == 0
    assert ranks[-1] >= 3


def test_promises_are_kept_or_refused_in_words():
    plan = oi.plan(_scene(), 0.05, "irradiance")
    assert plan.predicted_error <= 0.05
    assert planning.model_label(plan.transport) in plan.why
    hopeless = oi.plan(_scene(), 1e-5, "radiance")
    assert hopeless.predicted_error > 1e-5
    assert "no transport promises" in hopeless.why


def test_waters_unlike_those_of_the_fit_are_said_to_be():
    assert "a guess" not in oi.plan(_scene(sky=0.05), 0.03).why
    like = _water()
    white = oi.IOPs(WAVELENGTH, 1e-3 * like.a_components, 100.0 + like.b_components, like.phases)
    assert "a guess" in oi.plan(_scene(water=white), 0.03).why


def test_every_candidate_has_an_error_model():
    for quantity in planning.QUANTITIES:
        for transport in planning.CANDIDATES[quantity]:
            assert np.isfinite(
                error_model.error_models()[quantity, planning.model_label(transport)].coefficients
            ).all()


def test_a_floor_out_of_reach_is_dropped_and_a_near_one_is_not():
    far = oi.plan(_scene(floor=300.0), 0.05, "radiance", depth=2.0)
    assert far.scene.floor is None
    assert not far.terms["floor"].kept
    near = oi.plan(_scene(floor=3.0), 0.05, "radiance", depth=2.0)
    assert near.scene.floor is not None


def test_the_floors_bound_is_not_exceeded():
    for depth, floor in ((1.0, 4.0), (4.0, 4.5), (5.0, 12.0)):
        scene = _scene(floor=floor)
        bands = error_model.bands_of(scene, _water())
        from oceaninv.fidelity.scene_terms import _floor_bound

        bound = _floor_bound(bands, np.full(len(WAVELENGTH), depth), scene, "irradiance")
        change = np.max(np.abs(_ed(scene, depth) / _ed(_scene(), depth) - 1))
        assert change <= bound


def test_a_black_sky_is_dropped_and_a_bright_one_is_not():
    assert oi.plan(_scene(sky=0.0), 0.1).scene.light.diffuse is None
    bright = oi.plan(_scene(sky=0.1), 0.1)
    assert bright.scene.light.diffuse is not None
    assert bright.terms["sky"].bound > 0.1


def test_layers_that_are_alike_become_one_water():
    alike = oi.Layers(jnp.array([3.0]), (_water(), _water()))
    plan = oi.plan(_scene(water=alike), 0.05)
    assert isinstance(plan.scene.water, oi.IOPs)
    np.testing.assert_allclose(plan.scene.water.a, _water().a, rtol=1e-12)
    unlike = oi.Layers(jnp.array([3.0]), (_water(), _water(5.0)))
    plan = oi.plan(_scene(water=unlike), 0.05)
    assert isinstance(plan.transport, oi.PlaneParallel)
    assert "does not solve layers" in plan.why


def test_inelastic_terms_are_judged_one_by_one():
    """Raman light matters in the red at depth, not in the blue near the surface."""
    inelastic = oi.Inelastic(raman=oi.Raman())
    scene = _scene(inelastic=inelastic)
    kept = scene_terms.reduced_scene(scene, 0.002, "irradiance", None)
    assert kept[2]["raman"].kept
    blue = scene_terms.reduced_scene(scene, 0.3, "radiance", 0.01)
    assert not blue[2]["raman"].kept
    assert blue[0].inelastic is None


def test_fewer_bands_do_for_a_photograph():
    plan = oi.plan(_scene(), 0.1, "photograph", depth=3.0)
    assert 3 <= len(plan.bands) < len(WAVELENGTH)
    assert len(oi.plan(_scene(), 1e-4, "photograph", depth=3.0).bands) == len(WAVELENGTH)
    assert len(oi.plan(_scene(), 0.1, "irradiance").bands) == len(WAVELENGTH)


def _operations(scene):
    def program(a, scene):
        here = oi.Scene(
            oi.IOPs(WAVELENGTH, a, scene.water.b_components, scene.water.phases),
            scene.light,
            scene.surface,
            scene.floor,
        )
        return oi.irradiance(here, jnp.array([1.0, 2.0])).Ed.value

    compiled = jax.jit(lambda a: program(a, scene)).lower(scene.water.a_components).compile()
    return _flops(compiled)


def test_dropped_terms_are_absent_from_the_program():
    """Operation counts: the planned scene is the one written without the terms."""
    planned = oi.plan(_scene(floor=300.0, sky=0.0), 0.05, depth=2.0).scene
    lean, full = _operations(planned), _operations(_scene(floor=300.0, sky=0.0))
    assert abs(lean / _operations(_scene()) - 1) < 0.02
    assert lean < 0.8 * full


def _asked(scene, transport, quantity):
    """Operations of an answer, floating numbers of the scene traced, before any compiler."""

    def program(numbers):
        here, key = eqx.combine(numbers, rest), jax.random.key(0)
        if quantity == "irradiance":
            return oi.irradiance(here, jnp.array([1.0, 2.0]), transport, key=key).Ed.value
        rays = oi.Rays(jnp.array([[0.0, 0.0, 1.0]]), jnp.array([[0.6, 0.0, 0.8]]))
        return oi.radiance(here, rays, transport, key=key).value

    spec = jax.tree.map(lambda _: False, scene)
    spec = eqx.tree_at(lambda s: (s.water.a_components, s.light.direct), spec, (True, True))
    numbers, rest = eqx.partition(scene, spec)
    return _flops(jax.jit(program).lower(numbers))


@pytest.mark.parametrize("quantity", ["irradiance", "radiance"])
@pytest.mark.parametrize(
    "transport",
    [
        oi.KdTransport(),
        oi.TwoStream(),
        pytest.param(oi.FourStream(), marks=pytest.mark.slow),
        pytest.param(oi.PlaneParallel(4, 2), marks=pytest.mark.slow),
        pytest.param(oi.MonteCarlo(32, 4), marks=pytest.mark.slow),
    ],
    ids=planning.model_label,
)
def test_a_term_that_is_not_there_costs_nothing(transport, quantity, monkeypatch):
    """What the plan leaves is the program of a scene that was written without these terms, of
    every transport; each term that is there costs something."""
    # Nodes split at a surface go with fewer moments of phase functions, which is another saving.
    monkeypatch.setattr(
        "oceaninv.transport.plane_parallel.plane_parallel._flux_moments", lambda scene, n: 2 * n
    )
    one = jnp.ones(len(WAVELENGTH))
    far, dark = oi.Floor(300.0, 0.3 * one), 0.0 * one
    glow = oi.Inelastic(raman=oi.Raman(1e-12)) if transport.inelastic else None
    full = oi.Scene(_water(), oi.Light(40.0, one, dark), oi.FlatSurface(), far, inelastic=glow)
    planned = oi.plan(full, 0.05, quantity, depth=2.0).scene
    assert planned.floor is None
    assert planned.inelastic is None
    written = oi.Scene(_water(), oi.Light(40.0, one), oi.FlatSurface())
    least = _asked(written, transport, quantity)
    assert abs(_asked(planned, transport, quantity) / least - 1) < 0.02
    bare = oi.Scene(_water(), oi.Light(40.0, one))
    assert _asked(bare, transport, quantity) < least
    floor = oi.Scene(_water(), written.light, written.surface, far)
    if isinstance(transport, oi.KdTransport):
        with pytest.raises(ValueError, match="neither floor nor sky"):
            _asked(floor, transport, quantity)
    else:
        assert _asked(floor, transport, quantity) > least
    if glow is not None:
        emitting = oi.Scene(_water(), written.light, written.surface, inelastic=glow)
        assert _asked(emitting, transport, quantity) > least


def test_a_bare_scene_costs_what_its_formula_does():
    """KdTransport without surface, floor, sky and inelastic light beside its formula by hand."""
    one, depths = jnp.ones(len(WAVELENGTH)), jnp.array([1.0, 2.0])
    scene = oi.Scene(_water(), oi.Light(40.0, one))

    def by_hand(numbers):
        water = oi.IOPs(WAVELENGTH, numbers[0], _water().b_components, _water().phases)
        light = oi.Light(40.0, numbers[1])
        kd = oi.attenuation.kd_lee2005(water.a, water.bb, light.zenith)
        return (light.cosine * light.direct)[None, :] * jnp.exp(-kd[None, :] * depths[:, None])

    numbers = (_water().a_components, one)
    lean = _flops(jax.jit(by_hand).lower(numbers))
    assert abs(_asked(scene, oi.KdTransport(), "irradiance") / lean - 1) < 0.02


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.1, "brightness"), "irradiance, radiance, photograph"),
        ((0.0, "irradiance"), "between 0 and 1"),
        ((1.5, "irradiance"), "between 0 and 1"),
    ],
)
def test_bad_arguments_are_a_sentence(arguments, words):
    with pytest.raises(ValueError, match=words):
        oi.plan(_scene(), *arguments)
    with pytest.raises(ValueError, match="at least 0 m"):
        oi.plan(_scene(), 0.1, "radiance", depth=-1.0)


def test_traced_values_are_refused():
    def choose(scale):
        scene = _scene()
        light = oi.Light(40.0, scale * jnp.ones(len(WAVELENGTH)))
        return oi.plan(oi.Scene(scene.water, light), 0.1).predicted_error

    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(choose)(1.0)
