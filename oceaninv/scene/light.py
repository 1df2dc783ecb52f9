"""Sun and sky above the surface; lamps in the water."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv.foundation import tables
from oceaninv.water.iops import check_concrete, check_scalar


class AbstractSky(eqx.Module):
    """The radiance of a sky against zenith angle, the same for all wavelengths and azimuths."""

    @abc.abstractmethod
    def shape(self, cosine: Float[Array, " ray"]) -> Float[Array, " ray"]:
        """Radiance at the cosine of the zenith angle, relative to a uniform sky that gives the
        same irradiance."""


class CardioidalSky(AbstractSky):
    """An overcast sky: radiance in proportion to 1 + 2 cos(zenith) (Moon & Spencer 1942)."""

    def shape(self, cosine: Float[Array, " ray"]) -> Float[Array, " ray"]:
        return 3 / 7 * (1 + 2 * cosine)


class TabulatedSky(AbstractSky):
    """A sky whose radiance is known at some zenith angles; linear in the cosine between them.

    **Arguments:** `zenith`: (angle,) degrees, concrete, increasing from 0 to 90; `radiance`:
    (angle,) in any unit, not all 0.  Others raise ValueError.
    """

    cosine: tuple[float, ...] = eqx.field(static=True)
    radiance: Float[Array, " angle"]

    def __init__(self, zenith, radiance):
        zenith = np.asarray(zenith, dtype=float)
        check_concrete("radiance", radiance)
        radiance = jnp.asarray(radiance)
        self.radiance = radiance.astype(jnp.result_type(float, radiance))
        if zenith.ndim != 1 or zenith.shape != self.radiance.shape or zenith.size < 2:
            raise ValueError(
                f"zenith and radiance must be two vectors of one length, 2 at least, not of shapes "
                f"{zenith.shape} and {self.radiance.shape}."
            )
        if zenith[0] != 0 or zenith[-1] != 90 or np.any(np.diff(zenith) <= 0):
            raise ValueError("zenith must increase from 0 to 90 degrees.")
        self.cosine = tuple(np.cos(np.radians(zenith))[::-1].tolist())

    def shape(self, cosine: Float[Array, " ray"]) -> Float[Array, " ray"]:
        x = np.array(self.cosine)
        x[0] = 0.0
        values = self.radiance[::-1]
        # The integral of 2 mu over the hat of each node.
        step, weight = np.diff(x), np.zeros_like(x)
        weight[:-1] += step * (2 * x[:-1] + x[1:]) / 3
        weight[1:] += step * (x[:-1] + 2 * x[1:]) / 3
        mean = jnp.sum(jnp.asarray(weight, dtype=values.dtype) * values)
        seen = jnp.interp(cosine, jnp.asarray(x, cosine.dtype), values.astype(cosine.dtype))
        return seen / mean.astype(cosine.dtype)


class Light(eqx.Module):
    """A sun and, optionally, a sky.

    **Arguments:**

    - `zenith`: sun zenith angle in degrees, 0 <= zenith < 90: in air, or in the water when the
      scene has no surface.
    - `direct`: (wl,) irradiance of the sunbeam on a plane normal to the beam, above the surface,
      W m-2 nm-1 (any unit: results come out in the same).
    - `diffuse`: (wl,) radiance of a uniform sky, W m-2 sr-1 nm-1; `None` is a black sky.
    - `sky`: `CardioidalSky()` or `TabulatedSky(...)`, which spread the irradiance of that uniform
      sky, pi times `diffuse`, unevenly; `None` is uniform.
    """

    zenith: Float[Array, ""]
    direct: Float[Array, " wl"]
    diffuse: Float[Array, " wl"] | None
    sky: AbstractSky | None

    def __init__(self, zenith, direct, diffuse=None, sky=None):
        if sky is not None and diffuse is None:
            raise ValueError("a sky needs diffuse, the radiance of the uniform sky as bright.")
        self.sky = sky
        check_scalar("zenith", zenith)
        check_concrete("zenith", zenith, 0.0, 89.9)
        check_concrete("direct", direct)
        self.direct = jnp.asarray(direct)
        if self.direct.ndim != 1:
            raise ValueError(
                "direct must hold one value per wavelength, shape (wl,), not shape "
                f"{self.direct.shape}."
            )
        self.zenith = jnp.asarray(zenith, dtype=self.direct.dtype)
        if diffuse is not None:
            check_concrete("diffuse", diffuse)
            diffuse = jnp.asarray(diffuse, dtype=self.direct.dtype)
            if diffuse.shape != self.direct.shape:
                raise ValueError(
                    f"diffuse must have the shape of direct, {self.direct.shape}, "
                    f"not {diffuse.shape}."
                )
        self.diffuse = diffuse

    @property
    def cosine(self) -> Float[Array, ""]:
        """Cosine of the sun zenith angle."""
        return jnp.cos(jnp.deg2rad(self.zenith))

    def sky_radiance(self, cosine: Float[Array, " ray"]) -> Float[Array, "ray wl"]:
        """Radiance of the sky at the cosine of a zenith angle in air; 0 for a black sky."""
        if self.diffuse is None:
            return jnp.zeros((cosine.shape[0], self.direct.shape[0]), dtype=self.direct.dtype)
        shape = jnp.ones_like(cosine) if self.sky is None else self.sky.shape(cosine)
        return jnp.outer(shape, self.diffuse)


def clear_sky(
    wavelength: tables.Wavelengths,
    zenith: float | int,
    aerosol: float | int = 0.1,
    water_vapour: float | int = 1.5,
    ozone: float | int = 0.3,
) -> tuple[Float[np.ndarray, " wl"], Float[np.ndarray, " wl"]]:
    """Sun and sky of a cloudless day at sea level, for `Light(zenith, direct, diffuse)`.

    **Arguments:** `wavelength`: nm, concrete, 300 to 4000; `zenith`: degrees, 0 to 85; `aerosol`:
    optical depth at 500 nm; `water_vapour`: cm of precipitable water; `ozone`: atm cm.

    **Returns:** irradiance of the sunbeam across itself, W m-2 nm-1, and the radiance of a uniform
    sky with the same horizontal irradiance, W m-2 sr-1 nm-1; at the mean distance of the sun.

    **Raises:** `ValueError` out of range, `ImportError` without pvlib (the extra `sky`).

    Source: Bird & Riordan 1986 (SPECTRL2), through pvlib.
    """
    wavelength = tables.check_wavelength(wavelength)
    check_concrete("zenith", zenith, 0.0, 85.0)
    if wavelength[0] < 300 or wavelength[-1] > 4000:
        raise ValueError("a clear sky covers 300-4000 nm; the wavelengths reach beyond.")
    try:
        from pvlib.atmosphere import get_relative_airmass
        from pvlib.spectrum import spectrl2
    except ImportError:
        raise ImportError(
            "a clear sky needs pvlib: pip install pvlib, or give the light another spectrum, for "
            "instance D65."
        ) from None

    found = spectrl2(
        apparent_zenith=float(zenith),
        aoi=float(zenith),
        surface_tilt=0.0,
        ground_albedo=0.06,  # of the sea
        surface_pressure=101325.0,
        relative_airmass=get_relative_airmass(float(zenith)),
        precipitable_water=float(water_vapour),
        ozone=float(ozone),
        aerosol_turbidity_500nm=float(aerosol),
        dayofyear=94,  # the sun at its mean distance
    )
    grid = found["wavelength"]
    direct, diffuse = (np.ravel(found[name]) for name in ("dni", "poa_sky_diffuse"))
    sky = np.interp(wavelength, grid, diffuse) / np.pi
    return np.interp(wavelength, grid, direct), sky


class AbstractLamp(eqx.Module):
    """A small lamp in the water.  Subclasses are final."""

    position: eqx.AbstractVar[Float[Array, "3"]]
    intensity: eqx.AbstractVar[Float[Array, " wl"]]

    @abc.abstractmethod
    def along(self, direction: Float[Array, "3"]) -> Float[Array, " wl"]:
        """Radiant intensity (W sr-1 nm-1) that leaves the lamp along a unit vector."""


class PointLamp(AbstractLamp):
    """A lamp that shines equally in all directions.

    - `position`: (3,) metres, z the depth.
    - `intensity`: (wl,) W sr-1 nm-1: the irradiance across its light at r metres is
      intensity e^(-c r)/r^2.
    """

    position: Float[Array, "3"]
    intensity: Float[Array, " wl"]

    def __init__(self, position, intensity):
        self.position, self.intensity = _lamp(position, intensity)

    def along(self, direction: Float[Array, "3"]) -> Float[Array, " wl"]:
        """See `AbstractLamp`."""
        return self.intensity


class SpotLamp(AbstractLamp):
    """A lamp that shines uniformly into a cone and not outside it.

    - `position`: (3,) metres; `direction`: (3,) the way it shines, of any length.
    - `half_angle`: from the axis to the edge of the cone, degrees, 0 < half_angle <= 90.
    - `intensity`: (wl,) W sr-1 nm-1 within the cone.
    """

    position: Float[Array, "3"]
    direction: Float[Array, "3"]
    half_angle: Float[Array, ""]
    intensity: Float[Array, " wl"]

    def __init__(self, position, direction, half_angle, intensity):
        check_concrete("half_angle", half_angle, 1e-3, 90.0)
        self.position, self.intensity = _lamp(position, intensity)
        direction = jnp.asarray(direction, dtype=self.intensity.dtype)
        if direction.shape != (3,):
            raise ValueError(f"direction must be three numbers, not {direction.shape}.")
        length = jnp.sqrt(jnp.sum(direction**2))
        check_concrete("the length of direction", length, float(np.finfo(np.float32).tiny))
        self.direction = direction / length
        self.half_angle = jnp.asarray(half_angle, dtype=self.intensity.dtype)

    def along(self, direction: Float[Array, "3"]) -> Float[Array, " wl"]:
        """See `AbstractLamp`."""
        lit = jnp.dot(self.direction, direction) >= jnp.cos(jnp.deg2rad(self.half_angle))
        return jnp.where(lit, self.intensity, 0.0)


def _lamp(position, intensity):
    check_concrete("intensity", intensity)
    intensity = jnp.asarray(intensity)
    if intensity.ndim != 1:
        raise ValueError(f"intensity must have shape (wl,), not {intensity.shape}.")
    position = jnp.asarray(position, dtype=intensity.dtype)
    check_concrete("position", position, -np.inf)
    if position.shape != (3,):
        raise ValueError(f"position must be three numbers x, y, z in metres, not {position.shape}.")
    return position, intensity
