"""What a traced walk is worth at every wavelength: an analytic function of the water.

weight = scalar * product over layers of (b/sigma)^k exp(-(c - sigma) S) * (rho/rho0)^hits * mixing,
where mixing is the phase function over the density that was sampled.  It is exact for any a, b,
floor and phase parameters, and so are its derivatives; only how fast the average settles depends on
the proposal.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo._random_numbers import half_angle_table
from oceaninv.transport.monte_carlo._random_walk import Flight, Lanes, Proposal, Vertex
from oceaninv.water.iops import IOPs
from oceaninv.water.phase import AbstractPhase, Isotropic

_TINY = 1e-20  # 1/m: scattering coefficients below count as this in a logarithm


class Medium(NamedTuple):
    """The water of every layer against a proposal: `c` and `excess` = c - sigma (1/m), `log_b` =
    ln(b/sigma), `rows` of b by shape, all (..., wl); `log_floor` = ln(rho/rho0) or None."""

    c: tuple[Float[Array, " wl"], ...]
    excess: tuple[Float[Array, " wl"], ...]
    log_b: tuple[Float[Array, " wl"], ...]
    rows: tuple[Float[Array, "shape wl"], ...]
    phases: tuple[tuple[AbstractPhase, ...], ...]
    log_floor: Float[Array, " wl"] | None
    things: Float[Array, "thing wl"]


def waters(scene: Scene) -> tuple[IOPs, ...]:
    """The layers' waters from the surface down."""
    return (scene.water,) if isinstance(scene.water, IOPs) else scene.water.iops


def mixed(scene: Scene) -> bool:
    """Whether walks carry a spectral factor: a layer has several phase functions, so that the
    spectrum of a scattering depends on its angle, or objects have spectra of their own."""
    return bool(scene.objects) or any(len(w.phases) > 1 for w in waters(scene))


@eqx.filter_jit
def propose(scene: Scene) -> Proposal:
    """The proposal made for a scene: flights at the least attenuation of all bands, angles from the
    mean phase function.  No band's weights then grow along a path."""
    scene = jax.lax.stop_gradient(scene)
    rates, tables, decay = [], [], []
    for water in waters(scene):
        tiny = jnp.asarray(1e-6, water.c.dtype)
        rates.append(jnp.maximum(jnp.min(water.c), tiny))
        tables.append(half_angle_table(water.phases, jnp.mean(water.b_components, axis=1)))
        even = 1.0 - jnp.stack([jnp.asarray(p.asymmetry, tiny.dtype) for p in water.phases])
        # Diffusion, and absorption alone where nothing is scattered.
        fall = jnp.sqrt(water.a * (water.a + 3.0 * (even @ water.b_components)))
        decay.append(jnp.min(jnp.minimum(fall, water.c)))
    floor = jnp.zeros_like(rates[0])
    if scene.floor is not None:
        # Not 0: a black floor has derivatives that need walks which touch it.
        floor = jnp.maximum(jnp.mean(scene.floor.reflectance), 0.02)
    things = [jnp.maximum(jnp.mean(thing.reflectance), 0.02) for thing in scene.objects]
    things = jnp.stack(things) if things else jnp.zeros((0,), floor.dtype)
    return Proposal(jnp.stack(rates), jnp.stack(tables), floor, things, jnp.stack(decay))


def reflectances(scene: Scene) -> Float[Array, "thing wl"]:
    """Of the objects."""
    if not scene.objects:
        return jnp.zeros((0, len(scene.wavelength)), scene.light.direct.dtype)
    return jnp.stack([thing.reflectance for thing in scene.objects])


def medium(scene: Scene, proposal: Proposal, spectral: bool) -> Medium:
    """The scene's water, relative to a proposal; `spectral`: whether walks carry that factor."""
    layers = waters(scene)
    log_floor = None

    def log_b(b):
        # Where a spectral factor is carried, the derivative runs through it.
        return _log(jax.lax.stop_gradient(b) if spectral else b)

    if scene.floor is not None:
        log_floor = _log(scene.floor.reflectance) - _log(proposal.floor)
    return Medium(
        tuple(w.c for w in layers),
        tuple(w.c - s for w, s in zip(layers, proposal.rate, strict=True)),
        tuple(log_b(w.b) - jnp.log(s) for w, s in zip(layers, proposal.rate, strict=True)),
        tuple(w.b_components for w in layers),
        tuple(w.phases for w in layers),
        log_floor,
        reflectances(scene) / proposal.things[:, None],
    )


def _log(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """ln(value), with the derivative of the first power kept where value is 0."""
    fixed = jax.lax.stop_gradient(value)
    floored = jnp.maximum(fixed, _TINY)
    return jnp.log(floored) + (value - fixed) / floored


def outer(lane: Float[Array, "..."], band: Float[Array, " wl"]) -> Float[Array, "... wl"]:
    """lane times band, with the band as the last axis."""
    return lane[..., None] * band.reshape((1,) * lane.ndim + (-1,))


def attenuated(medium: Medium, lanes: Lanes, beyond: tuple) -> Float[Array, "... wl"]:
    """The walks' weights by wavelength, without the scalar one, after further lengths by layer."""
    exponent = jnp.zeros(lanes.weight.shape + medium.c[0].shape, lanes.weight.dtype)
    for i, more in enumerate(beyond):
        exponent -= outer(lanes.lengths[i], medium.excess[i])
        exponent -= outer(more, medium.c[i])
        exponent += outer(lanes.counts[i], medium.log_b[i])
    if medium.log_floor is not None:
        exponent += outer(lanes.floors, medium.log_floor)
    value = jnp.exp(exponent)
    return value if lanes.spectral is None else value * lanes.spectral


def own_share(medium: Medium, vertex: Vertex, cosine: Float[Array, "..."]) -> Float[Array, "..."]:
    """Share of a scattering's light that a direction drawn by the phase function stands for, beside
    one drawn evenly: p / (p + 1/(4 pi)) with the mean phase function (balance heuristic, Veach &
    Guibas 1995); 1 where nothing was scattered."""
    share = jnp.ones_like(cosine)
    for i, (rows, phases) in enumerate(zip(medium.rows, medium.phases, strict=True)):
        amounts = jax.lax.stop_gradient(jnp.mean(rows, axis=1)) + _TINY
        parts = zip(amounts / jnp.sum(amounts), phases, strict=True)
        p = 4.0 * jnp.pi * sum((w * q(cosine) for w, q in parts), start=jnp.zeros_like(cosine))
        share = jnp.where(vertex.scattered & (vertex.layer == i), p / (p + 1.0), share)
    return share


def volume_scattering(
    medium: Medium, proposal: Proposal, vertex: Vertex, cosine: Float[Array, "..."]
) -> Float[Array, "... wl"]:
    """b p(cosine) over the rate of the proposal, (1/sr), in the layer of each vertex."""
    value = jnp.zeros(cosine.shape + medium.c[0].shape, cosine.dtype)
    for i, (rows, phases) in enumerate(zip(medium.rows, medium.phases, strict=True)):
        share = jnp.where(vertex.scattered & (vertex.layer == i), 1.0 / proposal.rate[i], 0.0)
        for row, phase in zip(rows, phases, strict=True):
            value += outer(share * phase(cosine), row)
    return value


def scatter(
    medium: Medium, lanes: Lanes, vertex: Vertex, ahead: Flight, cosine: Array, density: Array
) -> tuple[Float[Array, "..."], Float[Array, "... wl"] | None]:
    """Scalar and spectral factors of a new direction drawn with `density` at `cosine`."""
    scalar = jnp.ones_like(lanes.weight)
    spectral = lanes.spectral
    for i, (rows, phases) in enumerate(zip(medium.rows, medium.phases, strict=True)):
        here = vertex.scattered & (vertex.layer == i)
        ratios = [phase(cosine) / density for phase in phases]
        if spectral is None:
            scalar = jnp.where(here, ratios[0], scalar)
        else:
            whole = jnp.maximum(jax.lax.stop_gradient(jnp.sum(rows, axis=0)), _TINY)
            factor = jnp.zeros_like(spectral)
            for ratio, row in zip(ratios, rows, strict=True):
                factor += outer(ratio, row / whole)
            spectral = jnp.where(here[..., None], spectral * factor, spectral)
    if ahead.thing is not None and spectral is not None:
        struck = ~vertex.scattered & ahead.met
        spectral = jnp.where(struck[..., None], spectral * (ahead.thing @ medium.things), spectral)
    return scalar, spectral


def comb(
    medium: Medium,
    lanes: Lanes,
    kept: int,
    u: Float[Array, " unit"],
    worth: Float[Array, "unit lane"] | float = 1.0,
) -> Lanes:
    """`kept` of the lanes of every unit (unit, lane), drawn by importance: their share of the
    light, the mean of all bands, times what it is worth."""
    lanes_now = jax.lax.stop_gradient(lanes)
    nowhere = tuple(jnp.zeros_like(s) for s in lanes.lengths)
    value = lanes_now.weight[..., None] * attenuated(
        jax.lax.stop_gradient(medium), lanes_now, nowhere
    )
    tiny = jnp.finfo(value.dtype).tiny
    shares = value / jnp.maximum(jnp.sum(value, axis=1, keepdims=True), tiny)
    proposal_share = lanes_now.weight / jnp.maximum(
        jnp.sum(lanes_now.weight, axis=1, keepdims=True), tiny
    )
    # A tenth by the proposal's own weights: also lanes that count only in a derivative live on.
    return taken(lanes, *chosen((jnp.mean(shares, axis=2) + 0.1 * proposal_share) * worth, kept, u))


def chosen(
    importance: Float[Array, "unit lane"], kept: int, u: Float[Array, " unit"]
) -> tuple[Int[Array, "unit kept"], Float[Array, "unit kept"]]:
    """`kept` of the lanes of every unit, drawn evenly along their summed importance: which, in
    their order, and how many copies of each are to be expected."""
    most = jnp.max(importance, axis=1, keepdims=True)
    importance = jnp.where(most > 0, importance / jnp.where(most > 0, most, 1.0), 1.0)
    upto = jnp.cumsum(importance, axis=1)
    whole = upto[:, -1:]
    # Lane i is passed by all draws from `starts` on; how many lanes a draw has passed, it takes.
    starts = jnp.clip(jnp.ceil(upto / whole * kept - u[:, None]), 0, kept).astype(jnp.int32)
    passed = jax.vmap(lambda at: jnp.zeros(kept + 1, jnp.int32).at[at].add(1))(starts)
    lane = jnp.minimum(jnp.cumsum(passed, axis=1)[:, :kept], importance.shape[1] - 1)
    return lane, kept * jnp.take_along_axis(importance, lane, axis=1) / whole


def taken(
    lanes: Lanes, lane: Int[Array, "unit kept"], copies: Float[Array, "unit kept"] | None
) -> Lanes:
    """The lanes chosen, with weights that leave every expected value as it is."""

    def take(leaf):
        index = lane.reshape(lane.shape + (1,) * (leaf.ndim - 2))
        return jnp.take_along_axis(leaf, index, axis=1)

    lanes = jax.tree.map(take, lanes)
    if copies is None:
        return lanes
    # Rounding may choose a lane of no importance, at the end of the row.
    there = copies > 0
    return lanes._replace(weight=jnp.where(there, lanes.weight / jnp.where(there, copies, 1.0), 0))


def settled(medium: Medium, lanes: Lanes) -> Lanes:
    """Lanes whose spectral factor holds all that their lengths and counts did."""
    zero = jnp.zeros_like(lanes.weight)
    nothing = (zero,) * len(lanes.lengths)
    spectral = attenuated(medium, lanes, nothing)
    return lanes._replace(lengths=nothing, counts=nothing, floors=zero, spectral=spectral)


def similar(proposal: Proposal, medium: Medium) -> tuple[Proposal, Medium]:
    """The water that scatters evenly and b (1 - g) as much, which far inside differs little
    (similarity theory; Frisvad et al. 2007, section 3).  For lanes with a spectral factor."""
    rows, c, rates = [], [], []
    for own, phases, attenuation in zip(medium.rows, medium.phases, medium.c, strict=True):
        even = 1.0 - jnp.stack([jnp.asarray(p.asymmetry, own.dtype) for p in phases])
        row = even @ own
        rows.append(row[None])
        c.append(attenuation - jnp.sum(own, axis=0) + row)
        rates.append(jnp.maximum(jax.lax.stop_gradient(jnp.min(c[-1])), 1e-6))
    table = jnp.linspace(0.0, 1.0, proposal.tables.shape[1], dtype=proposal.tables.dtype)
    tables = jnp.broadcast_to(table, proposal.tables.shape)
    proposal = Proposal(jnp.stack(rates), tables, proposal.floor, proposal.things, proposal.decay)
    medium = medium._replace(
        c=tuple(c),
        excess=tuple(own - rate for own, rate in zip(c, rates, strict=True)),
        log_b=tuple(
            _log(jax.lax.stop_gradient(row[0])) - jnp.log(rate)
            for row, rate in zip(rows, rates, strict=True)
        ),
        rows=tuple(rows),
        phases=((Isotropic(),),) * len(rows),
    )
    return proposal, medium
