"""The public forward functions with their domains, for tests at the corners of these.

A case is a function of a vector of scalars.  Every argument lists its corners: zeros, tiny and huge
values, removable singularities, values that make two arguments equal.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import oceaninv as oi
from oceaninv.foundation import interface_optics
from oceaninv.water import attenuation, phase

# Coefficients (1/m) and lengths (m): from a vacuum to a wall.  Below 1e-12 /m, a millionth of a
# millionth of the clearest water, squares leave the range of single precision: 0 or more than that.
COEFFICIENT = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 30.0, 1e3)
LENGTH = (0.0, 1e-12, 1e-6, 1e-3, 1.0, 20.0, 1e3)
POSITIVE = COEFFICIENT[1:]
ZENITH = (0.0, 1e-6, 30.0, 60.0, 89.0)
COSINE = (-1.0, -0.999999, -0.5, -1e-9, 0.0, 1e-9, 0.5, 0.6666, 0.999999, 1.0)
ASYMMETRY = (-0.9, -1e-9, 0.0, 1e-9, 0.5, 0.924, 0.98)
SHARE = (0.0, 1e-12, 0.3, 1.0 - 1e-9, 1.0)
INDEX = (1.0, 1.0 + 1e-6, 1.34, 1.6)
LOOK = (-1.0, -0.7, -1e-3, 0.0, 1e-12, 1e-3, 0.7, 1.0)


@dataclasses.dataclass(frozen=True)
class Case:
    """`function`: of (argument,) to an array; `corners`: per argument; `agree`: largest difference
    of float32 from float64, over the larger of the value and `scale`; `slow`: heavy to compile;
    `least_share`: of the second argument, below which the first (absorption beside scattering) is
    lost in single precision, so that the two precisions are not compared."""

    name: str
    function: Callable
    corners: tuple[tuple[float, ...], ...]
    agree: float = 2e-5
    scale: float = 1e-6
    slow: bool = False
    least_share: float = 0.0

    def points(self, count: int, seed: int) -> np.ndarray:
        """(count, argument): two thirds corners with corners, the rest between them."""
        rng = np.random.default_rng(seed)
        columns = []
        for corners in self.corners:
            corner = rng.choice(corners, count)
            low, high = min(corners), max(corners)
            least = min((c for c in corners if c > 0), default=1.0)
            even = rng.uniform(low, high, count)
            steps = np.exp(rng.uniform(np.log(least), np.log(max(high, least)), count))
            between = np.where(rng.random(count) < 0.5, even, np.clip(steps, low, high))
            columns.append(np.where(rng.random(count) < 0.67, corner, between))
        return np.stack(columns, axis=1)


def _wide(p):
    """A wavelength axis of one for each scalar of p."""
    return [v[None] for v in p]


def _water(a, b, g):
    return oi.IOPs([550.0], a[None], b[None], phase.HenyeyGreenstein(g))


def _deep(p, sky=None):
    a, b, g, zenith = p[:4]
    one = jnp.ones_like(a)[None]
    diffuse = None if sky is None else sky[None]
    return oi.Scene(_water(a, b, g), oi.Light(zenith, one, diffuse), oi.FlatSurface())


def _over_floor(p):
    deep, (depth, rho) = _deep(p, p[6]), p[4:6]
    return oi.Scene(deep.water, deep.light, deep.surface, oi.Floor(depth, rho[None]))


def _ray(z, down):
    across = jnp.sqrt(jnp.maximum(1.0 - down**2, 0.0))
    # The derivative of the direction is not of the matter here.
    direction = jax.lax.stop_gradient(jnp.stack([0.6 * across, 0.8 * across, down]))
    return oi.Rays(jnp.stack([0.0 * z, 0.0 * z, z])[None], direction[None])


def _field(found):
    return jnp.concatenate([found.Ed.value[0], found.Eu.value[0], found.E0.value[0]])


def _radiance_deep(transport, p):
    return oi.radiance(_deep(p), _ray(p[4], p[5]), transport).value[0]


def _irradiance_deep(transport, p):
    return _field(oi.irradiance(_deep(p), p[4:5], transport))


def _radiance_floor(transport, p):
    return oi.radiance(_over_floor(p), _ray(p[7] * p[4], p[8]), transport).value[0]


def _irradiance_floor(transport, p):
    return _field(oi.irradiance(_over_floor(p), (p[7] * p[4])[None], transport))


_DEEP = (COEFFICIENT, COEFFICIENT, ASYMMETRY, ZENITH)
_FLOOR = (*_DEEP, LENGTH[2:], SHARE, SHARE, SHARE)


def _transports():
    for transport, name, slow, share, agree in (
        (oi.TwoStream(), "two-stream", False, 0.0, 2e-3),
        (oi.FourStream(), "four-stream", True, 1e-5, 2e-2),
    ):
        radiance, irradiance = (
            (f"{name}, {q}", functools.partial(f, transport))
            for q, f in (("radiance, deep", _radiance_deep), ("irradiance, deep", _irradiance_deep))
        )
        yield Case(*radiance, (*_DEEP, LENGTH, LOOK), agree, 1e-3, True, share)
        yield Case(*irradiance, (*_DEEP, LENGTH), agree, 1e-3, slow, share)
        yield Case(
            f"{name}, radiance, floor",
            functools.partial(_radiance_floor, transport),
            (*_FLOOR, LOOK),
            agree,
            1e-3,
            True,
            share,
        )
        yield Case(
            f"{name}, irradiance, floor",
            functools.partial(_irradiance_floor, transport),
            _FLOOR,
            agree,
            1e-3,
            True,
            share,
        )
    yield Case(
        "Kd transport, irradiance",
        lambda p: _irradiance_deep(oi.KdTransport(), p),
        (POSITIVE[1:], *_DEEP[1:], LENGTH),
        2e-3,
        1e-3,
    )
    yield Case(
        "Kd transport, radiance",
        lambda p: _radiance_deep(oi.KdTransport(), p),
        (POSITIVE[1:], *_DEEP[1:], LENGTH, LOOK),
        2e-3,
        1e-3,
        True,
    )


def _constituents(p):
    water = oi.BioOpticalModel().iops(
        oi.Constituents(p[0], cdom=p[1], detritus=p[2]), np.array([410.0, 550.0, 690.0])
    )
    return jnp.concatenate([water.a, water.b, water.bb, water.albedo])


def _spot(p):
    lamp = oi.SpotLamp(p[:3] * 0.0, jnp.stack([0 * p[0], 0 * p[0], 1 + 0 * p[0]]), p[3], p[4:5])
    return lamp.along(p[:3] / jnp.sqrt(jnp.sum(p[:3] ** 2)))


def table() -> tuple[Case, ...]:
    """Every case."""
    small = {
        "Henyey-Greenstein": (
            lambda p: phase.HenyeyGreenstein(p[0])(p[1]),
            (ASYMMETRY, COSINE),
        ),
        "Henyey-Greenstein, moments": (
            lambda p: phase.HenyeyGreenstein(p[0]).moments(8),
            (ASYMMETRY,),
        ),
        "Henyey-Greenstein, bb/b": (
            lambda p: phase.HenyeyGreenstein(p[0]).backscatter_ratio,
            (ASYMMETRY,),
        ),
        "two-term Henyey-Greenstein": (
            lambda p: phase.TwoTermHenyeyGreenstein(p[0], p[1], p[2])(p[3]),
            (ASYMMETRY, ASYMMETRY, SHARE, COSINE),
        ),
        "sea water": (lambda p: phase.Seawater(p[0])(p[1]), (SHARE, COSINE)),
        "Fournier-Forand": (
            lambda p: phase.FournierForand(index=p[0], slope=p[1])(p[2]),
            ((1.001, 1.05, 1.15, 1.3), (3.001, 3.5, 4.0, 4.999), COSINE),
        ),
        "refraction": (
            lambda p: interface_optics.refracted_cosine(p[0], p[1]),
            (POSITIVE[3:7], INDEX),
        ),
        "Fresnel from air": (
            lambda p: interface_optics.fresnel_from_air(p[0], p[1]),
            ((1e-6, 0.1, 0.5, 1.0), INDEX[1:]),
        ),
        "Fresnel from water": (
            lambda p: interface_optics.fresnel_from_water(p[0], p[1]),
            ((0.0, 1e-6, 0.3, 0.6656, 0.67, 1.0), INDEX[1:]),
        ),
        "diffuse reflectance": (
            lambda p: jnp.stack(interface_optics.diffuse_reflectance(p[0])),
            (INDEX[1:],),
        ),
        "Kd, Gordon": (
            lambda p: attenuation.kd_gordon1989(*_wide(p[:2]), p[2]),
            (COEFFICIENT, COEFFICIENT, (0.1, 0.66, 1.0)),
        ),
        "Kd, Kirk": (
            lambda p: attenuation.kd_kirk1984(*_wide(p[:2]), p[2]),
            (COEFFICIENT, COEFFICIENT, (0.5, 0.66, 1.0)),
        ),
        "Kd, Lee 2005": (
            lambda p: attenuation.kd_lee2005(*_wide(p[:2]), p[2]),
            (COEFFICIENT, COEFFICIENT, ZENITH),
        ),
        "Kd, Lee 2013": (
            lambda p: attenuation.kd_lee2013(*_wide(p[:3]), p[3]),
            (COEFFICIENT, COEFFICIENT, COEFFICIENT, ZENITH),
            # Water that scatters more than all: the difference may all but vanish.
            2e-3,
        ),
        "Kd, mean": (
            lambda p: attenuation.kd_mean(*_wide(p[:3]), p[3], p[4:5], p[5])[0],
            (COEFFICIENT, COEFFICIENT, COEFFICIENT, (0.3, 1.0), LENGTH, SHARE),
            # At a << b it is a small sum of large terms.
            1e-3,
        ),
        "Kd, Morel & Maritorena": (
            lambda p: attenuation.kd_morel_maritorena2001(p[0], np.array([440.0, 550.0])),
            ((0.0, 1e-30, 1e-6, 0.02, 1.0, 30.0, 1e3),),
        ),
        "R": (
            lambda p: attenuation.irradiance_reflectance(*_wide(p[:2]), p[2]),
            (COEFFICIENT, COEFFICIENT, (0.1, 0.66, 1.0)),
        ),
        "constituents": (_constituents, (COEFFICIENT, COEFFICIENT, COEFFICIENT)),
        "spot lamp": (
            _spot,
            ((-1.0, 1e-3, 1.0), (-1.0, 1e-3, 1.0), LOOK[:2] + LOOK[5:], (1.0, 45.0), COEFFICIENT),
        ),
    }
    simple = tuple(Case(name, *rest) for name, rest in small.items())
    return (*simple, *_transports())


@functools.cache
def program(case: Case):
    """Compiled (points, argument) -> values and Jacobians."""

    def both(p):
        def value(p):
            out = jnp.ravel(case.function(p))
            return out, out

        slope, out = jax.jacfwd(value, has_aux=True)(p)
        return out, slope

    return jax.jit(jax.vmap(both))


def failures(case: Case, points: np.ndarray) -> list[str]:
    """What is wrong at these points, at most a few sentences: not finite, or single precision and
    double disagree."""
    out = []
    values = {}
    for dtype in (np.float64, np.float32):
        at = points.astype(dtype)
        value, slope = (np.asarray(x) for x in program(case)(jnp.asarray(at)))
        values[dtype] = value.astype(float)
        for what, array in (("value", value), ("derivative", slope)):
            bad = ~np.isfinite(array).reshape(len(at), -1).all(axis=1)
            if bad.any():
                out.append(
                    f"{case.name}: {bad.sum()} of {len(at)} {what}s are not finite in "
                    f"{np.dtype(dtype).name}, first at {at[bad][0].tolist()}"
                )
    # Single precision is judged at the points that it was given.
    exact = np.asarray(program(case)(jnp.asarray(points.astype(np.float32).astype(float)))[0])
    gap = np.abs(values[np.float32] - exact) / np.maximum(np.abs(exact), case.scale)
    if case.least_share:
        gap = np.where((points[:, 0] < case.least_share * points[:, 1])[:, None], 0.0, gap)
    bad = ~(gap <= case.agree).all(axis=1)
    if bad.any():
        worst = np.unravel_index(np.nanargmax(gap), gap.shape)
        out.append(
            f"{case.name}: float32 is off by {gap[worst]:.2g} at {points[worst[0]].tolist()} and "
            f"by more than {case.agree:g} at {bad.sum()} of {len(points)}"
        )
    return out
