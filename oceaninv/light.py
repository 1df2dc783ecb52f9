"""Sun and sky above the surface; lamps in the water."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from oceaninv import tables
from oceaninv.iops import check_concrete


class Light(eqx.Module):
    """A sun and, optionally, a uniform sky.

    **Arguments:**

    - `zenith`: sun zenith angle in degrees, 0 <= zenith < 90: in air, or in the water when the
      scene has no surface.
    - `direct`: (wl,) irradiance of the sunbeam on a plane normal to the beam, above the surface,
      W m-2 nm-1 (any unit: results come out in the same).
    - `diffuse`: (wl,) radiance of a uniform sky, W m-2 sr-1 nm-1; `None` is a black sky.
    """

    zenith: Float[Array, ""]
    direct: Float[Array, " wl"]
    diffuse: Float[Array, " wl"] | None

    def __init__(self, zenith, direct, diffuse=None):
        check_concrete("zenith", zenith, 0.0, 89.9)
        check_concrete("direct", direct)
        self.direct = jnp.asarray(direct)
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
        raise ImportError('a clear sky needs pvlib: pip install "oceaninv[sky]".') from None

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
    """A lamp that shines alike in all directions.

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
    """A lamp that shines evenly into a cone and not beside it.

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
