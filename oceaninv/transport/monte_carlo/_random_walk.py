"""Random walks through layered water, traced once for every wavelength.

A walk is drawn from a `Proposal` that does not depend on wavelength: free flights at a rate sigma
per layer, scattering angles from one table per layer.  `WalkBatch` keeps what determines its weight
in any water: lengths and scattering counts per layer, floor hits, one scalar weight.  Nothing here
is differentiated.

A flight never leaves the water.  Of the light that reaches a boundary, only the reflected share
competes with scattering; the light that leaves is scored by its expected value.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from oceaninv.foundation.interface_optics import fresnel_from_water
from oceaninv.foundation.numerics import safe_sqrt
from oceaninv.scene.objects import AbstractObject, nearest
from oceaninv.transport.monte_carlo._random_numbers import (
    Vector,
    lambertian,
    sample_half_angle,
    turn,
)

_BOUNCED = 0.75  # greatest probability of a reflection where scattering is possible
_RARE = 0.4  # times the root of a small probability of reflection: the least that is used
LEVEL = 1e-4  # flights closer to horizontal than this cosine stay in their layer


class Domain(NamedTuple):
    """The geometry of a scene.

    `edges`: depths between layers; `floor`: depth or None; `refraction`: the index of water under a
    flat surface, or None; `things`: objects with rows of the identity matrix as reflectances, which
    tell which object was met and keep the true reflectances differentiable.
    """

    edges: Float[Array, " interface"]
    floor: Float[Array, ""] | None
    refraction: Float[Array, ""] | None
    things: tuple[AbstractObject, ...] = ()


class Proposal(eqx.Module):
    """The distribution that walks are drawn from.

    `rate` (1/m) and `tables` of angles by layer; `floor`, `things`: reflectances of the floor and
    of each object; `decay`: rate at which light decays with depth (1/m).
    """

    rate: Float[Array, " layer"]
    tables: Float[Array, "layer edge"]
    floor: Float[Array, ""]
    things: Float[Array, " thing"]
    decay: Float[Array, " layer"]


class WalkBatch(NamedTuple):
    """A batch of random walks, (unit, walk).

    `weight`: scalar factor; `lengths` (m) and `counts` of scatterings, one array per layer;
    `floors`: floor hits; `spectral`: factors (..., wl), None where the counts suffice; `limit`:
    length (m) at which a line of sight ends, None where none ends; `own`: the share of a flight's
    light that the walk itself scores, None where it scores all.
    """

    position: Vector
    direction: Vector
    weight: Float[Array, "..."]
    lengths: tuple[Float[Array, "..."], ...]
    counts: tuple[Float[Array, "..."], ...]
    floors: Float[Array, "..."]
    spectral: Float[Array, "... wl"] | None
    limit: Float[Array, "..."] | None
    own: Float[Array, "..."] | None = None


class Flight(NamedTuple):
    """The straight path ahead of a walk, to the next boundary or object.

    `up`: whether upwards; `ends`: whether it ends at the surface or floor; `lengths` by layer and
    `distance` in all (0 where endless); `reflectance` of the surface; `optical` length at the
    proposal's rate; `returned`: the share that comes back from the end; `thing`: which object it
    meets (a row of zeros for none), and its `normal`; both None in scenes without objects.
    """

    up: Bool[Array, "..."]
    lengths: tuple[Float[Array, "..."], ...]
    ends: Bool[Array, "..."]
    reflectance: Float[Array, "..."]
    optical: Float[Array, "..."]
    distance: Float[Array, "..."]
    returned: Float[Array, "..."]
    thing: Float[Array, "... thing"] | None = None
    normal: Vector | None = None

    @property
    def met(self) -> Bool[Array, "..."]:
        """Whether an object stands in the way."""
        return jnp.zeros_like(self.ends) if self.thing is None else jnp.any(self.thing > 0, axis=-1)


def each(function, *arguments):
    """function(vectors (3,), scalars), mapped over the walks (unit, walk) of its arguments."""
    stacked = (jnp.stack(a, axis=-1) if isinstance(a, tuple) else a for a in arguments)
    return jax.vmap(jax.vmap(function))(*stacked)


def bounds(domain: Domain) -> list[tuple[Array | float, Array | float]]:
    """(top, bottom) of every layer; the last ends at the floor or never."""
    last = jnp.inf if domain.floor is None else domain.floor
    return list(zip([0.0, *domain.edges], [*domain.edges, last], strict=True))


def layer_of(domain: Domain, depth: Float[Array, "..."]) -> Int[Array, "..."]:
    """Index of the layer at a depth."""
    layer = jnp.zeros(depth.shape, jnp.int32)
    for edge in domain.edges:
        layer = jnp.where(depth >= edge, layer + 1, layer)
    return layer


def by_layer(domain: Domain, start, end, length) -> tuple[Float[Array, "..."], ...]:
    """How a straight length between two depths divides among the layers."""
    if domain.edges.shape[0] == 0:
        return (length,)
    rise = jnp.abs(end - start)
    level = rise <= jnp.finfo(start.dtype).tiny
    scale = length / jnp.where(level, 1.0, rise)
    own = layer_of(domain, start)
    parts = []
    for i, (top, bottom) in enumerate(bounds(domain)):
        overlap = jnp.abs(jnp.clip(end, top, bottom) - jnp.clip(start, top, bottom))
        parts.append(jnp.where(level, jnp.where(own == i, length, 0.0), overlap * scale))
    return tuple(parts)


def total(lengths: tuple, rates) -> Array:
    """Sum of lengths times rates, layer by layer."""
    return jnp.sum(jnp.stack([s * r for s, r in zip(lengths, rates, strict=True)]), axis=0)


def flight(domain: Domain, proposal: Proposal, walks: WalkBatch) -> Flight:
    """The path from the position of each walk to the boundary ahead."""
    z, mu = walks.position[2], walks.direction[2]
    up = mu < 0
    level = jnp.abs(mu) < LEVEL
    steep = jnp.where(level, 1.0, jnp.abs(mu))
    end = jnp.where(up, 0.0, 0.0 if domain.floor is None else domain.floor)
    ends = (up | (domain.floor is not None)) & ~level
    distance = jnp.where(ends, jnp.abs(end - z) / steep, 0.0)
    bounded = ends
    thing = normal = None
    if domain.things:
        hit = each(lambda o, d: nearest(domain.things, o, d), walks.position, walks.direction)
        met = hit.distance < jnp.where(ends, distance, jnp.inf)
        if walks.limit is not None:
            met = met & (hit.distance <= walks.limit)
        distance = jnp.where(met, hit.distance, distance)
        ends, bounded = ends & ~met, ends | met
        end = jnp.where(met, z + mu * distance, end)
        thing = jnp.where(met[..., None], hit.reflectance, 0.0)
        normal = tuple(hit.normal[..., i] for i in range(3))
    if walks.limit is not None:
        cut = walks.limit < jnp.where(bounded, distance, jnp.inf)
        distance = jnp.where(cut, walks.limit, distance)
        ends, bounded = ends & ~cut, ends | cut
        end = jnp.where(cut, z + mu * walks.limit, end)
    lengths = by_layer(domain, z, jnp.where(bounded, end, z), distance)
    optical = jnp.where(bounded, total(lengths, proposal.rate), jnp.inf)
    reflectance = jnp.zeros_like(z)
    if domain.refraction is not None:
        reflectance = fresnel_from_water(jnp.abs(mu), domain.refraction)
    back = jnp.where(up, reflectance, proposal.floor)
    back = jnp.where(ends, back, 0.0)
    if thing is not None:
        back = back + thing @ proposal.things
    returned = jnp.where(bounded, jnp.exp(-optical) * back, 0.0)
    return Flight(up, lengths, ends, reflectance, optical, distance, returned, thing, normal)


def _scattered_at(domain: Domain, proposal: Proposal, walks: WalkBatch, depth: Array):
    """The position of a walk after an optical depth: (length, z)."""
    z, mu = walks.position[2], walks.direction[2]
    own = proposal.rate[layer_of(domain, z)]
    straight = depth / own
    if domain.edges.shape[0] == 0:
        return straight, z + straight * mu
    level = jnp.abs(mu) < LEVEL
    above, target = jnp.zeros_like(z), jnp.zeros_like(z)
    layers = [(i, top, bottom) for i, (top, bottom) in enumerate(bounds(domain))]
    for i, top, bottom in layers:
        above = above + proposal.rate[i] * (jnp.clip(z, top, bottom) - top)
    remaining = above + depth * mu
    for i, top, bottom in layers:
        target = target + jnp.clip(remaining / proposal.rate[i], 0.0, bottom - top)
        remaining = remaining - proposal.rate[i] * (bottom - top)
    length = jnp.where(level, straight, (target - z) / jnp.where(level, 1.0, mu))
    return length, jnp.where(level, z + straight * mu, target)


class Vertex(NamedTuple):
    """The end of a flight: `scattered` in the water, else at a boundary."""

    scattered: Bool[Array, "..."]
    layer: Int[Array, "..."]


def advance(
    domain: Domain,
    proposal: Proposal,
    walks: WalkBatch,
    ahead: Flight,
    u: tuple,
    rate: Float[Array, "..."] | None = None,
) -> tuple[WalkBatch, Vertex]:
    """The walks at the ends of their flights, before their change of direction.  The weight of a
    walk that scattered lacks the factor of phase function over density of the new direction.
    `rate`: rate at which flights are drawn relative to the proposal's; None: 1."""
    scatters = -jnp.expm1(-ahead.optical)
    kept = ahead.returned + scatters
    # Even in the thinnest water one walk in four scatters.
    chance = ahead.returned / jnp.where(kept > 0, kept, 1.0)
    # Light that returns from far away is rare, but may be the only light there is.
    chance = jnp.minimum(jnp.maximum(chance, _RARE * safe_sqrt(chance)), _BOUNCED)
    bounced = u[3] < chance
    if rate is None:
        depth = jnp.minimum(-jnp.log1p(u[0] * jnp.expm1(-ahead.optical)), ahead.optical)
        drawn = scatters
    else:
        within = jnp.expm1(-rate * ahead.optical)
        depth = jnp.minimum(-jnp.log1p(u[0] * within) / rate, ahead.optical)
        drawn = -within / rate * jnp.exp((rate - 1.0) * depth)
    share = jnp.where(
        bounced, ahead.returned / jnp.where(bounced, chance, 1.0), drawn / (1.0 - chance)
    )
    length, z = _scattered_at(domain, proposal, walks, depth)
    end = jnp.where(ahead.up, 0.0, 0.0 if domain.floor is None else domain.floor)
    if domain.things:
        struck = walks.position[2] + ahead.distance * walks.direction[2]
        end = jnp.where(ahead.met, struck, end)
    z = jnp.where(bounced, end, jnp.maximum(z, 0.0))
    if domain.floor is not None:
        z = jnp.minimum(z, domain.floor)
    length = jnp.where(bounced, ahead.distance, length)
    parts = by_layer(domain, walks.position[2], z, length)
    layer = layer_of(domain, z)
    scattered = ~bounced & (scatters > 0)
    x, y, _ = walks.position
    counts = tuple(
        jnp.where(scattered & (layer == i), k + 1.0, k) for i, k in enumerate(walks.counts)
    )
    walks = walks._replace(
        position=(x + length * walks.direction[0], y + length * walks.direction[1], z),
        weight=walks.weight * share,
        lengths=tuple(s + d for s, d in zip(walks.lengths, parts, strict=True)),
        counts=counts,
        floors=jnp.where(bounced & ahead.ends & ~ahead.up, walks.floors + 1.0, walks.floors),
    )
    return walks, Vertex(scattered, layer)


def deflect(
    proposal: Proposal, walks: WalkBatch, vertex: Vertex, ahead: Flight, u: tuple
) -> tuple[Vector, Float[Array, "..."], Float[Array, "..."]]:
    """New directions; with them the cosine of the scattering angle and the density (1/sr) of the
    scattered ones."""
    half, density = sample_half_angle(proposal.tables, vertex.layer, u[1])
    scattered = turn(walks.direction, half, u[2])
    x, y, z = walks.direction
    normal = (jnp.zeros_like(x), jnp.zeros_like(x), -jnp.ones_like(x))
    up = ahead.up
    if ahead.normal is not None:
        met = ahead.met
        pairs = zip(ahead.normal, normal, strict=True)
        normal = tuple(jnp.where(met, own, floor) for own, floor in pairs)
        up = up & ~met
    from_floor = lambertian(normal, u[1], u[2])
    mirrored = (x, y, -z)
    direction = tuple(
        jnp.where(vertex.scattered, s, jnp.where(up, m, f))
        for s, m, f in zip(scattered, mirrored, from_floor, strict=True)
    )
    return direction, 1.0 - 2.0 * half, density
