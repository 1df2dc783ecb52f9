"""Light of charts lit by a lamp at the camera, and light scattered back by the water between."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from oceaninv import IOPs
from oceaninv.foundation.numerics import gauss_legendre

_NODES, _WEIGHTS = gauss_legendre(40, 0.0, 1.0)


def lamplit(
    water: IOPs,
    lamp: Float[Array, " wl"],
    distance: Float[Array, " ray"],
    overlap_distance: Float[Array, ""],
) -> tuple[Float[Array, "ray wl"], Float[Array, "ray wl"]]:
    """Light of a white chart, and of the water before it, at the camera.

    - `lamp`: radiant intensity (any unit, W sr-1 nm-1 say) of a lamp at the camera that shines
      evenly on what is seen; `distance`: metres to the chart; `overlap_distance`: metres
      before the camera at which lamp and view begin to overlap (some tenths for a lamp on an arm).

    White chart: I e^(-2 c P) / (pi P^2).  Water, in single scattering straight back:

        I beta(180) int_B^P e^(-2 c r) / r^2 dr = I beta(180) [E2(2 c B) / B - E2(2 c P) / P],

    with E2 the exponential integral (Abramowitz & Stegun 1964, 5.1.4); 0 for a chart nearer than
    B.  Neglected: light scattered more than once, forward scattering included, and daylight.
    """
    twice = 2.0 * water.c
    through = jnp.exp(-twice[None, :] * distance[:, None])
    chart = lamp[None, :] * through / (jnp.pi * distance[:, None] ** 2)
    back = water.volume_scattering(-jnp.ones(1, distance.dtype))[0]
    dtype = distance.dtype
    nodes, weights = jnp.asarray(_NODES, dtype), jnp.asarray(_WEIGHTS, dtype)
    # The two E2 together, by quadrature in ln r: library ones take longer to compile than the
    # rest of a fit, and their differences lose digits.  Beyond e^-36 no light returns.
    nearest = jnp.maximum(distance, overlap_distance)[:, None]
    far = jnp.minimum(nearest, overlap_distance + 36.0 / twice[None, :])
    span = jnp.log(far / overlap_distance)
    r = overlap_distance * jnp.exp(span[:, :, None] * nodes[None, None, :])
    path = span * jnp.sum(weights[None, None, :] * jnp.exp(-twice[None, :, None] * r) / r, axis=-1)
    return chart, lamp[None, :] * back[None, :] * path
