"""Solid, opaque, Lambertian objects in the water, and their intersections with straight lines.

`nearest` and `blocked` take one line; map them over many.  A direction is the unit vector along
which the line is followed (a line of sight from the eye, a shadow line towards the sun).  Metres;
z is the depth.  Distances and normals are differentiable, forward and reverse, in the line and in
the shapes; the choice of the object that is met is not (its derivative is 0).
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.water.iops import check_concrete

# Larger than any distance under water, but its square fits in float32.
_FAR = 1e15


class Hit(eqx.Module):
    """The point where a line meets an object.

    `distance`: metres, inf if it meets none.  `normal`: unit vector of the surface, on the side
    from which the line comes; 0 if there is none.  `reflectance`: 0 if there is none.
    """

    distance: Float[Array, ""]
    normal: Float[Array, "3"]
    reflectance: Float[Array, " wl"]


class AbstractObject(eqx.Module):
    """A solid with one diffuse reflectance.  Subclasses are final.

    A line that starts on a surface does not meet it again at its start: intersections nearer than
    `_skin` times the object's size are ignored.
    """

    reflectance: eqx.AbstractVar[Float[Array, " wl"]]

    @abc.abstractmethod
    def meet(
        self, origin: Float[Array, "3"], direction: Float[Array, "3"]
    ) -> tuple[Float[Array, ""], Float[Array, "3"]]:
        """Distance (inf if none) and a unit normal, of either sign."""

    @abc.abstractmethod
    def extent(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Least and greatest depth, m."""


def _skin(dtype) -> float:
    """Share of an object's size within which rounding cannot tell a surface from its inside."""
    return 4.0 * float(np.finfo(dtype).eps) ** 0.5


def _reflectance(value) -> Float[Array, " wl"]:
    check_concrete("reflectance", value, 0.0, 1.0)
    value = jnp.asarray(value)
    if value.ndim != 1:
        raise ValueError(f"reflectance must have shape (wl,), not {value.shape}.")
    return value


def _point(name: str, value, dtype) -> Float[Array, "3"]:
    value = jnp.asarray(value, dtype=dtype)
    check_concrete(name, value, -np.inf)
    if value.shape != (3,):
        raise ValueError(f"{name} must be three numbers x, y, z in metres, not {value.shape}.")
    return value


class Sphere(AbstractObject):
    """A sphere: `centre` (3,) m, `radius` m > 0, `reflectance` (wl,) between 0 and 1."""

    centre: Float[Array, "3"]
    radius: Float[Array, ""]
    reflectance: Float[Array, " wl"]

    def __init__(self, centre, radius, reflectance):
        check_concrete("radius", radius, float(np.finfo(np.float32).tiny))
        self.reflectance = _reflectance(reflectance)
        self.centre = _point("centre", centre, self.reflectance.dtype)
        self.radius = jnp.asarray(radius, dtype=self.reflectance.dtype)

    def meet(self, origin: Float[Array, "3"], direction: Float[Array, "3"]):
        """See `AbstractObject`."""
        apart = self.centre - origin
        along = jnp.dot(apart, direction)
        # The distance of the line from the centre, computed first: exact even from far away.
        across = apart - along * direction
        squared = self.radius**2 - jnp.dot(across, across)
        half = safe_sqrt(squared)
        near, far = along - half, along + half
        least = _skin(near.dtype) * self.radius
        distance = jnp.where(near > least, near, far)
        met = (squared > 0) & (distance > least)
        distance = jnp.where(met, distance, 0.0)
        normal = (distance * direction - apart) / self.radius
        return jnp.where(met, distance, jnp.inf), normal

    def extent(self):
        """See `AbstractObject`."""
        return self.centre[2] - self.radius, self.centre[2] + self.radius


class Box(AbstractObject):
    """A box with horizontal and vertical sides along x and y.

    `lower`, `upper` (3,) m: the corners of least and greatest x, y and depth; `reflectance` (wl,).
    """

    lower: Float[Array, "3"]
    upper: Float[Array, "3"]
    reflectance: Float[Array, " wl"]

    def __init__(self, lower, upper, reflectance):
        self.reflectance = _reflectance(reflectance)
        self.lower = _point("lower", lower, self.reflectance.dtype)
        self.upper = _point("upper", upper, self.reflectance.dtype)
        check_concrete("upper - lower", self.upper - self.lower, float(np.finfo(np.float32).tiny))

    def meet(self, origin: Float[Array, "3"], direction: Float[Array, "3"]):
        """See `AbstractObject`."""
        entry, leave = _slab(self.lower, self.upper, origin, direction)
        first, last = jnp.max(entry), jnp.min(leave)
        least = _skin(first.dtype) * jnp.max(self.upper - self.lower)
        inside = first <= least
        distance = jnp.where(inside, last, first)
        met = (first < last) & (distance > least) & (distance < _FAR / 2)
        axis = jnp.where(inside, jnp.argmin(leave), jnp.argmax(entry))
        normal = (jnp.arange(3) == axis).astype(first.dtype)
        return jnp.where(met, distance, jnp.inf), normal

    def extent(self):
        """See `AbstractObject`."""
        return self.lower[2], self.upper[2]


def _slab(lower, upper, origin, direction):
    """Distances at which a line enters and leaves lower <= x <= upper, along each axis."""
    parallel = direction == 0
    step = jnp.where(parallel, 1.0, direction)
    one, other = (lower - origin) / step, (upper - origin) / step
    within = (origin >= lower) & (origin <= upper)
    entry = jnp.where(parallel, jnp.where(within, -_FAR, _FAR), jnp.minimum(one, other))
    leave = jnp.where(parallel, jnp.where(within, _FAR, -_FAR), jnp.maximum(one, other))
    return entry, leave


class HeightField(AbstractObject):
    """A surface given by its depth over a regular grid, bilinear between the grid's points.

    **Arguments:**

    - `depth`: (ny, nx) metres, at x0 + i spacing (second axis) and y0 + j spacing (first axis);
      at least 2 x 2 points.
    - `x0`, `y0`: metres; `spacing`: metres > 0.
    - `reflectance`: (wl,) between 0 and 1.

    It ends at the edge of the grid: add a floor below it if lines pass outside the grid.  A line
    takes one step per cell that it crosses between the least and the greatest depth.
    """

    depth: Float[Array, "ny nx"]
    x0: Float[Array, ""]
    y0: Float[Array, ""]
    spacing: Float[Array, ""]
    reflectance: Float[Array, " wl"]

    def __init__(self, depth, x0, y0, spacing, reflectance):
        self.reflectance = _reflectance(reflectance)
        dtype = self.reflectance.dtype
        check_concrete("depth", depth)
        self.depth = jnp.asarray(depth, dtype=dtype)
        if self.depth.ndim != 2 or min(self.depth.shape) < 2:
            raise ValueError(
                f"depth must be a grid (ny, nx) of at least 2 x 2 points, not {self.depth.shape}."
            )
        check_concrete("spacing", spacing, float(np.finfo(np.float32).tiny))
        for name, value in (("x0", x0), ("y0", y0)):
            check_concrete(name, value, -np.inf)
        self.x0, self.y0 = jnp.asarray(x0, dtype), jnp.asarray(y0, dtype)
        self.spacing = jnp.asarray(spacing, dtype)

    def meet(self, origin: Float[Array, "3"], direction: Float[Array, "3"]):
        """See `AbstractObject`."""
        # The cell is searched without derivative (a loop has no reverse mode), then the distance
        # is that of the bilinear patch over it.
        frozen = jax.lax.stop_gradient((self, origin, direction))
        met, row, column, start = _search(*frozen)
        root, _ = _patch(self, row, column, origin, direction, start)
        distance = jnp.where(met & jnp.isfinite(root), root, 0.0)
        across = (origin[:2] + distance * direction[:2] - self._corner(row, column)) / self.spacing
        base, slope_x, slope_y, twist = _corners(self.depth, row, column)
        del base
        normal = jnp.stack(
            [
                (slope_x + twist * across[1]) / self.spacing,
                (slope_y + twist * across[0]) / self.spacing,
                jnp.full_like(distance, -1.0),
            ]
        )
        found = met & jnp.isfinite(root)
        return jnp.where(found, distance, jnp.inf), normal / jnp.sqrt(jnp.sum(normal**2))

    def _corner(self, row, column) -> Float[Array, "2"]:
        """x and y of the corner of a cell."""
        dtype = self.spacing.dtype
        return jnp.stack(
            [
                self.x0 + column.astype(dtype) * self.spacing,
                self.y0 + row.astype(dtype) * self.spacing,
            ]
        )

    def extent(self):
        """See `AbstractObject`."""
        return jnp.min(self.depth), jnp.max(self.depth)


def _corners(depth, row, column):
    """Coefficients of depth = base + sx u + sy v + twist u v over a cell."""
    corner = depth[row, column]
    right, below = depth[row, column + 1] - corner, depth[row + 1, column] - corner
    return corner, right, below, depth[row + 1, column + 1] - corner - right - below


def _patch(field: HeightField, row, column, origin, direction, start):
    """Least distance beyond `start` at which a line meets the patch over one cell (inf if none),
    and the distances at which the line passes from the cell to its neighbours, (2,)."""
    s = field.spacing
    corner = field._corner(row, column)
    base, slope_x, slope_y, twist = _corners(field.depth, row, column)
    u, v = (origin[:2] - corner) / s
    du, dv = direction[:2] / s
    # origin z + t dz = base + sx u + sy v + twist u v, with u and v linear in t.
    square = -twist * du * dv
    linear = direction[2] - slope_x * du - slope_y * dv - twist * (u * dv + v * du)
    constant = origin[2] - base - slope_x * u - slope_y * v - twist * u * v
    discriminant = linear**2 - 4.0 * square * constant
    root = safe_sqrt(discriminant)
    # The stable pair of roots; without a square term the second is the only one.
    large = -0.5 * (linear + jnp.where(linear >= 0, root, -root))
    flat, none = square == 0, large == 0
    first = jnp.where(flat, jnp.inf, large / jnp.where(flat, 1.0, square))
    second = jnp.where(none, jnp.inf, constant / jnp.where(none, 1.0, large))
    edge = jnp.where(direction[:2] > 0, 1.0, 0.0)
    still = direction[:2] == 0
    leave = (corner + edge * s - origin[:2]) / jnp.where(still, 1.0, direction[:2])
    leave = jnp.where(still, _FAR, leave)
    slack = _skin(s.dtype) * s
    roots = jnp.stack([first, second])
    good = (discriminant >= 0) & (roots >= start) & (roots <= jnp.min(leave) + slack)
    return jnp.min(jnp.where(good, roots, jnp.inf)), leave


def _search(field: HeightField, origin, direction):
    """The cell in which a line first meets the field: (met, row, column, least distance)."""
    rows, columns = field.depth.shape[0] - 1, field.depth.shape[1] - 1
    s = field.spacing
    skin = _skin(s.dtype) * s
    low = jnp.stack([field.x0, field.y0, jnp.min(field.depth) - skin])
    size = jnp.asarray([columns, rows], dtype=s.dtype) * s
    high = jnp.concatenate([low[:2] + size, (jnp.max(field.depth) + skin)[None]])
    entry, leave = _slab(low, high, origin, direction)
    begin, end = jnp.maximum(jnp.max(entry), skin), jnp.min(leave)
    at = (origin[:2] + begin * direction[:2] - low[:2]) / s
    cell = jnp.clip(jnp.floor(at).astype(int), 0, jnp.asarray([columns - 1, rows - 1]))
    forward = jnp.where(direction[:2] > 0, 1, -1)

    def going(state):
        cell, start, met = state
        inside = (cell >= 0) & (cell < jnp.asarray([columns, rows]))
        return ~met & jnp.all(inside) & (start <= end)

    def step(state):
        cell, start, _ = state
        least = jnp.maximum(start - skin, skin)
        root, leave = _patch(field, cell[1], cell[0], origin, direction, least)
        met = root <= end + skin
        axis = jnp.argmin(leave)
        onward = cell + jnp.where(jnp.arange(2) == axis, forward, 0)
        return (
            jnp.where(met, cell, onward),
            jnp.where(met, start, jnp.maximum(jnp.min(leave), start)),
            met,
        )

    state = (cell, begin, jnp.zeros((), dtype=bool))
    cell, start, met = jax.lax.while_loop(going, step, state)
    cell = jnp.where(met, cell, 0)
    return met, cell[1], cell[0], jnp.maximum(start - skin, skin)


def nearest(
    objects: tuple[AbstractObject, ...], origin: Float[Array, "3"], direction: Float[Array, "3"]
) -> Hit:
    """What a line meets first; `objects` holds at least one."""
    distance = jnp.full((), jnp.inf, origin.dtype)
    normal = jnp.zeros_like(origin)
    reflectance = jnp.zeros_like(objects[0].reflectance)
    for thing in objects:
        far, facing = thing.meet(origin, direction)
        facing = jnp.where(jnp.dot(facing, direction) > 0, -facing, facing)
        first = far < distance
        distance = jnp.where(first, far, distance)
        normal = jnp.where(first, facing, normal)
        reflectance = jnp.where(first, thing.reflectance, reflectance)
    return Hit(distance, normal, reflectance)


def blocked(
    objects: tuple[AbstractObject, ...],
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    limit: Float[Array, ""],
) -> Bool[Array, ""]:
    """Whether a line meets any object nearer than `limit` metres."""
    shadow = jnp.zeros((), dtype=bool)
    for thing in objects:
        shadow = shadow | (thing.meet(origin, direction)[0] < limit)
    return shadow
