"""Values and derivatives of the forward functions at the corners of their domains."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import oceaninv as oi
from tests.reference import extremes as _extremes
from tests.reference import extremes_more as _extremes_more

CASES = (*_extremes.table(), *_extremes_more.more(), *_extremes_more.exact())
QUICK = [case for case in CASES if not case.slow]
POINTS = 256


@pytest.mark.parametrize("case", QUICK, ids=lambda case: case.name)
def test_corners(case):
    """Finite in value and derivative in both precisions, which agree."""
    assert not _extremes.failures(case, case.points(POINTS, 1))


@pytest.mark.slow
@pytest.mark.parametrize("case", [c for c in CASES if c.slow], ids=lambda case: case.name)
def test_corners_of_whole_transports(case):
    assert not _extremes.failures(case, case.points(POINTS, 1))


_CASE = next(case for case in QUICK if case.name == "two-stream, irradiance, deep")
_ARGUMENTS = st.tuples(
    *(
        st.one_of(
            st.sampled_from(corners),
            st.floats(*(float(np.float32(f(corners))) for f in (min, max)), width=32),
        )
        for corners in _CASE.corners
    )
)


def _in_domain(point) -> bool:
    return all(x == 0 or x >= 1e-12 for x in point[:2])


@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(_ARGUMENTS.filter(_in_domain), min_size=1, max_size=16))
def test_batches_of_mixed_extremes(points):
    """One bad row would show in its neighbours: the batch is padded to one size."""
    padded = np.resize(np.array(points, dtype=float), (POINTS, len(_CASE.corners)))
    value, slope = _extremes.program(_CASE)(jnp.asarray(padded))
    assert np.isfinite(value).all()
    assert np.isfinite(slope).all()


def test_slopes_are_those_of_finite_differences():
    """Between the corners, where a difference quotient can be trusted."""
    rng = np.random.default_rng(2)
    points = np.stack(
        [rng.uniform(low, high, POINTS) for low, high in ((0.05, 1), (0.05, 1), (0, 0.9), (5, 60))]
        + [rng.uniform(0.1, 5.0, POINTS)],
        axis=1,
    )
    run = _extremes.program(_CASE)
    slope = np.asarray(run(jnp.asarray(points))[1])
    for i in range(points.shape[1]):
        step = 1e-6 * np.eye(points.shape[1])[i]
        up, down = (np.asarray(run(jnp.asarray(points + s * step))[0]) for s in (1, -1))
        quotient = (up - down) / 2e-6
        assert np.max(np.abs(slope[:, :, i] - quotient) / (1 + np.abs(quotient))) < 2e-8


def camera(direction=(1.0, 0.0, 0.0), fov=60.0, width=4, port_index=None):
    up, response = (0.0, 0.0, -1.0), oi.spectrum.generic_camera()
    return oi.Camera((0.0, 0.0, 1.0), direction, up, fov, width, 3, response, port_index)


BAD = {
    "negative absorption": lambda: oi.IOPs(
        [500.0], jnp.array([-0.1]), jnp.ones(1), oi.phase.Isotropic()
    ),
    "absorption not a number": lambda: oi.IOPs(
        [500.0], jnp.array([np.nan]), jnp.ones(1), oi.phase.Isotropic()
    ),
    "endless scattering": lambda: oi.IOPs(
        [500.0], jnp.ones(1), jnp.array([np.inf]), oi.phase.Isotropic()
    ),
    "unsorted wavelengths": lambda: oi.IOPs(
        [500.0, 400.0], jnp.ones(2), jnp.ones(2), oi.phase.Isotropic()
    ),
    "asymmetry of 1": lambda: oi.phase.HenyeyGreenstein(1.0),
    "weight beyond 1": lambda: oi.phase.TwoTermHenyeyGreenstein(0.5, 0.1, 1.1),
    "depolarisation": lambda: oi.phase.Seawater(1.5),
    "bb/b of one half": lambda: oi.phase.FournierForand(0.5),
    "index below 1": lambda: oi.phase.FournierForand(index=0.9, slope=4.0),
    "slope beyond 5": lambda: oi.phase.FournierForand(index=1.1, slope=5.5),
    "sun on the horizon": lambda: oi.Light(90.0, jnp.ones(1)),
    "negative light": lambda: oi.Light(30.0, -jnp.ones(1)),
    "thin water": lambda: oi.FlatSurface(0.9),
    "floor at the surface": lambda: oi.Floor(0.0, jnp.ones(1)),
    "floor that shines": lambda: oi.Floor(3.0, jnp.array([1.2])),
    "half a stream": lambda: oi.PlaneParallel(1),
    "no azimuth order": lambda: oi.PlaneParallel(4, 0),
    "negative Kd": lambda: oi.KdTransport(jnp.array([-1.0])),
    "negative chlorophyll": lambda: oi.Constituents(-1.0),
    "negative size": lambda: oi.mie.efficiencies(-1.0, 1.5),
    "index that amplifies": lambda: oi.mie.efficiencies(1.0, 1.5 - 0.1j),
    "no wavelength": lambda: oi.mie.cross_sections(1.0, 0.0, 1.5, 1.34),
    "cosine beyond 1": lambda: oi.mie.phase_function(1.1, 1.0, 550.0, 1.5, 1.34),
    "cream": lambda: oi.media.milk(11.0, 3.0),
    "more algae than water": lambda: oi.media.natural_water(algae=1.5).bulk(np.array([550.0])),
    "camera without a view": lambda: camera(fov=0.0),
    "camera that looks up": lambda: camera(direction=(0.0, 0.0, -1.0)),
    "camera without pixels": lambda: camera(width=0),
    "air in the port": lambda: camera(port_index=0.9),
    "noise of no electrons": lambda: oi.Sensor(read_noise=2.0),
    "no exposure": lambda: oi.Sensor(exposure=0.0),
    "half a bit": lambda: oi.Sensor(bits=0),
    "sphere without size": lambda: oi.Sphere(jnp.zeros(3), 0.0, jnp.ones(1)),
    "box inside out": lambda: oi.Box(jnp.ones(3), jnp.zeros(3), jnp.ones(1)),
    "relief of a point": lambda: oi.HeightField(jnp.ones((1, 1)), 0.0, 0.0, 1.0, jnp.ones(1)),
    "lamp of no angle": lambda: oi.SpotLamp(jnp.zeros(3), jnp.ones(3), 0.0, jnp.ones(1)),
    "lamp that takes light": lambda: oi.PointLamp(jnp.zeros(3), -jnp.ones(1)),
    "sky without a horizon": lambda: oi.TabulatedSky(np.array([0.0, 60.0]), jnp.ones(2)),
    "negative Raman": lambda: oi.Raman(-1.0),
    "more photons out than in": lambda: oi.ChlorophyllFluorescence(1.5),
    "no walk": lambda: oi.MonteCarlo(paths=0),
    "walks without steps": lambda: oi.MonteCarlo(bounces=0),
    "no inelastic order": lambda: oi.PlaneParallel(4, 2, 0),
    "layers upside down": lambda: oi.Layers(
        jnp.array([3.0, 2.0]),
        (oi.IOPs([500.0], jnp.ones(1), jnp.ones(1), oi.phase.Isotropic()),) * 3,
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_outside_the_domain_is_a_sentence(name):
    with pytest.raises(ValueError, match=r".{15,}"):
        BAD[name]()
