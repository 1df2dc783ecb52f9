"""Waves on the surface, and the pattern of light that they focus: caustics."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from oceaninv.water.iops import check_concrete

_GRAVITY = 9.81  # m s-2
_SUN_RADIUS = np.radians(0.267)  # of its disc, in air
_RAYS = 4  # along each side of a pixel of the pattern


class Waves(eqx.Module):
    """A sum of long-crested waves that repeats itself from tile to tile.

    - `tile`: side of the square after which everything repeats, m.
    - `numbers`: (wave, 2) whole numbers of wave lengths that fit into a tile along x and y.
    - `amplitude`: (wave,) m; `phase`: (wave,) radians, at time 0 and x = y = 0.
    - `time`: s; waves travel as on deep water, frequency squared = g k.
    """

    tile: float = eqx.field(static=True)
    numbers: tuple[tuple[int, int], ...] = eqx.field(static=True)
    amplitude: Float[Array, " wave"]
    phase: Float[Array, " wave"]
    time: Float[Array, ""]

    def __init__(self, tile, numbers, amplitude, phase, time=0.0):
        check_concrete("tile", tile, 1e-3)
        check_concrete("amplitude", amplitude)
        check_concrete("phase", phase, -np.inf)
        check_concrete("time", time, -np.inf)
        whole = np.asarray(numbers)
        amplitude = jnp.asarray(amplitude)
        self.amplitude = amplitude.astype(jnp.result_type(float, amplitude))
        self.phase = jnp.asarray(phase).astype(self.amplitude.dtype)
        self.time = jnp.asarray(time, dtype=self.amplitude.dtype)
        n = self.amplitude.size
        shapes = (whole.shape, self.amplitude.shape, self.phase.shape)
        if shapes != ((n, 2), (n,), (n,)) or not np.issubdtype(whole.dtype, np.integer):
            raise ValueError(
                "numbers must be whole numbers (wave, 2) with amplitude and phase (wave,), not "
                f"{whole.dtype} {whole.shape}, {self.amplitude.shape} and {self.phase.shape}."
            )
        if np.any(np.all(whole == 0, axis=1)):
            raise ValueError("numbers must not be (0, 0): a wave has a length.")
        self.tile = float(tile)
        self.numbers = tuple((int(i), int(j)) for i, j in whole)

    def slopes(self, size: int) -> Float[Array, "2 size size"]:
        """Slope of the surface (its rise per metre) along x and y on a grid over the tile:
        second axis y, third x, both from 0 in steps of tile/size."""
        k = np.asarray(self.numbers)
        if 2 * np.max(np.abs(k)) >= size:
            raise ValueError(f"size {size} is too coarse for the shortest wave of the tile.")
        rate = 2 * np.pi / self.tile * k
        frequency = np.sqrt(_GRAVITY * np.linalg.norm(rate, axis=1))
        dtype = self.amplitude.dtype
        turned = self.phase - jnp.asarray(frequency, dtype) * self.time
        # d/dx a cos(k x + p) = -k a sin(k x + p) = Re(i k a e^(ip) e^(ikx)).
        strength = self.amplitude[None, :] * jnp.asarray(rate.T, dtype)
        parts = lax.complex(
            -strength * jnp.sin(turned)[None, :], strength * jnp.cos(turned)[None, :]
        )
        spectrum = jnp.zeros((2, size, size), parts.dtype)
        spectrum = spectrum.at[:, k[:, 1] % size, k[:, 0] % size].add(parts)
        return jnp.real(jnp.fft.ifft2(spectrum)) * size**2


def random_waves(
    tile: float | int,
    slope: float | int,
    longest: float | int,
    shortest: float | int,
    *,
    wind: float | int = 0.0,
    seed: int = 0,
    time: float | int = 0.0,
) -> Waves:
    """A wave field of every wave that fits the tile and has a length between two.

    **Arguments:** `tile`, `longest` <= `tile`, `shortest`: m; `slope`: root mean square of the
    slope, 0 to 0.3 (an open sea has sqrt(0.003 + 0.00512 U) for a wind of U m/s, Cox & Munk 1954,
    most of it from waves shorter than a picture shows); `wind`: the way in which they travel,
    degrees from +x towards +y, spread by a squared cosine; `time`: s.

    Slope variance per octave is the same for all lengths, on average.
    """
    if not 0 < shortest <= longest <= tile:
        raise ValueError(
            f"wave lengths need 0 < shortest <= longest <= tile, not {shortest:g}, {longest:g}"
            f" and {tile:g} m."
        )
    check_concrete("slope", slope, 0.0, 0.3)
    most = int(tile / shortest)
    if most > 128:
        raise ValueError(f"tile {tile:g} m holds more than 128 waves of {shortest:g} m: too fine.")
    i, j = (v.ravel() for v in np.meshgrid(*[np.arange(-most, most + 1)] * 2, indexing="ij"))
    length = tile / np.maximum(np.hypot(i, j), 1e-9)
    along = np.cos(np.arctan2(j, i) - np.radians(wind))
    kept = (length >= shortest) & (length <= longest) & (along > 1e-3)
    if not kept.any():
        raise ValueError(f"no wave between {shortest:g} and {longest:g} m fits {tile:g} m.")
    i, j, length, along = i[kept], j[kept], length[kept], along[kept]
    random = np.random.default_rng(seed)
    strength = np.abs(along) * length * random.rayleigh(size=i.size)
    amplitude = strength * length
    reached = np.sqrt(np.sum((2 * np.pi * amplitude / length) ** 2) / 2)
    numbers = np.stack([i, j], axis=1)
    phase = random.uniform(0, 2 * np.pi, i.size)
    return Waves(tile, numbers, amplitude * slope / reached, phase, time)


@eqx.filter_jit
def caustics(
    waves: Waves,
    zenith_cosine: Float[Array, ""],
    index: Float[Array, ""],
    depth: Float[Array, ""],
    size: int = 256,
) -> Float[Array, "size size"]:
    """Irradiance of the unscattered sun on a level plane, over that under a flat surface.

    **Arguments:** `zenith_cosine`: of the sun in air, which stands towards +x; `index`: of the
    water; `depth`: of the plane, m.

    **Returns:** (y, x) over one tile.  Each of many equal parcels of sunlight is refracted where
    it meets the sloping surface and deposited where it meets the plane; the sun's disc blurs the
    pattern.  The loss by reflection is that of a flat surface, so that the mean is exactly 1.  The
    waves are assumed to be low: light starts at depth 0.
    """
    fine = _RAYS * size
    x_slope, y_slope = waves.slopes(fine)
    dtype = x_slope.dtype
    index, depth = index.astype(dtype), depth.astype(dtype)
    mu = zenith_cosine.astype(dtype)
    across = -jnp.sqrt(1 - mu**2)  # the light travels away from the sun
    # The normal against the light, z down: (-slope x, -slope y, -1).
    length = jnp.sqrt(1 + x_slope**2 + y_slope**2)
    facing = (mu + across * x_slope) / length
    bend = facing / index - jnp.sqrt(1 - (1 - facing**2) / index**2)
    down = mu / index - bend / length
    to_x = (across / index - bend * x_slope / length) / down
    to_y = -bend * y_slope / length / down
    grid = jnp.arange(fine, dtype=dtype) / _RAYS
    pixel = waves.tile / size
    place_x = grid[None, :] + depth / pixel * to_x
    place_y = grid[:, None] + depth / pixel * to_y
    # A parcel carries the light that a level square of the surface catches.
    power = (mu + across * x_slope) / mu / _RAYS**2
    found = _laid_down(place_x, place_y, power, size)
    # The disc of the sun, a Gaussian of the same variance; a mean of 1 stays 1.
    blur = 0.5 * _SUN_RADIUS / index * depth
    k = jnp.asarray(2 * np.pi / waves.tile * np.fft.fftfreq(size, 1 / size), dtype)
    fade = jnp.exp(-0.5 * (blur * k) ** 2)
    spectrum = jnp.fft.fft2(found)
    blurred = spectrum * (fade[:, None] * fade[None, :]).astype(spectrum.dtype)
    return jnp.real(jnp.fft.ifft2(blurred))


def _laid_down(x, y, power, size: int) -> Float[Array, "size size"]:
    """Parcels at fractional pixels, each distributed over the nine pixels around it by quadratic
    splines; narrower kernels give moire between rows of parcels and of pixels."""
    total = jnp.zeros((size, size), power.dtype)
    left, top = jnp.round(x), jnp.round(y)
    columns, rows = _spline(x - left), _spline(y - top)
    left, top = left.astype(int) - 1, top.astype(int) - 1
    for dy, share_y in enumerate(rows):
        for dx, share_x in enumerate(columns):
            total = total.at[(top + dy) % size, (left + dx) % size].add(power * share_y * share_x)
    return total


def _spline(d):
    """Shares of the pixel before, the nearest and the one after."""
    return 0.5 * (0.5 - d) ** 2, 0.75 - d**2, 0.5 * (0.5 + d) ** 2


def looked_up(
    pattern: Float[Array, "size size"],
    tile: float,
    x: Float[Array, " ray"],
    y: Float[Array, " ray"],
) -> Float[Array, " ray"]:
    """Values of a pattern at places in metres, bilinear, from tile to tile."""
    size = pattern.shape[0]
    u, v = x * (size / tile), y * (size / tile)
    left, top = jnp.floor(u), jnp.floor(v)
    right, below = u - left, v - top
    i, j = left.astype(int) % size, top.astype(int) % size
    near = (1 - right) * pattern[j, i] + right * pattern[j, (i + 1) % size]
    down = (j + 1) % size
    far = (1 - right) * pattern[down, i] + right * pattern[down, (i + 1) % size]
    return (1 - below) * near + below * far
