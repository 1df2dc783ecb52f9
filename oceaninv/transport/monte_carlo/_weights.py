"""The weight of a traced walk at every wavelength, an analytic function of the water.

weight = scalar * product over layers of (b/sigma)^k exp(-(c - sigma) S) * (rho/rho0)^hits * mixing,
where mixing is the phase function over the sampled density.  The weight and its derivatives are
exact for any a, b, floor and phase parameters; the proposal affects the variance alone.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from oceaninv.scene.scene import Scene
from oceaninv.transport.monte_carlo._random_numbers import half_angle_table
from oceaninv.transport.monte_carlo._random_walk import Flight, Proposal, Vertex, WalkBatch
from oceaninv.water.iops import IOPs
from oceaninv.water.phase import AbstractPhase, Isotropic

_TINY = 1e-20  # 1/m: lower bound of scattering coefficients in a logarithm


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
    """Whether walks carry a spectral factor.  They do where a layer has several phase functions,
    so that the spectrum of a scattering depends on its angle, and where there are objects."""
    return bool(scene.objects) or any(len(w.phases) > 1 for w in waters(scene))


@eqx.filter_jit
def propose(scene: Scene) -> Proposal:
    """The proposal for a scene: flights drawn at the smallest attenuation of all bands, angles from
    the mean phase function.  Then the weights of no band grow along a path."""
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
        # Not 0: the derivatives with respect to a black floor need walks that touch it.
        floor = jnp.maximum(jnp.mean(scene.floor.reflectance), 0.02)
    things = [jnp.maximum(jnp.mean(thing.reflectance), 0.02) for thing in scene.objects]
    things = jnp.stack(things) if things else jnp.zeros((0,), floor.dtype)
    return Proposal(jnp.stack(rates), jnp.stack(tables), floor, things, jnp.stack(decay))


def reflectances(scene: Scene) -> Float[Array, "thing wl"]:
    """The reflectances of the objects."""
    if not scene.objects:
        return jnp.zeros((0, len(scene.wavelength)), scene.light.direct.dtype)
    return jnp.stack([thing.reflectance for thing in scene.objects])


def medium(scene: Scene, proposal: Proposal, spectral: bool) -> Medium:
    """The scene's water, relative to a proposal; `spectral`: whether walks carry that factor."""
    layers = waters(scene)
    log_floor = None

    def log_b(b):
        # If walks carry a spectral factor, it carries the derivative.
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


def outer(walk: Float[Array, "..."], band: Float[Array, " wl"]) -> Float[Array, "... wl"]:
    """`walk` times `band`, with the band as the last axis."""
    return walk[..., None] * band.reshape((1,) * walk.ndim + (-1,))


def attenuated(medium: Medium, walks: WalkBatch, beyond: tuple) -> Float[Array, "... wl"]:
    """The walks' weights by wavelength, without the scalar one, after further lengths by layer."""
    exponent = jnp.zeros(walks.weight.shape + medium.c[0].shape, walks.weight.dtype)
    for i, more in enumerate(beyond):
        exponent -= outer(walks.lengths[i], medium.excess[i])
        exponent -= outer(more, medium.c[i])
        exponent += outer(walks.counts[i], medium.log_b[i])
    if medium.log_floor is not None:
        exponent += outer(walks.floors, medium.log_floor)
    value = jnp.exp(exponent)
    return value if walks.spectral is None else value * walks.spectral


def own_share(medium: Medium, vertex: Vertex, cosine: Float[Array, "..."]) -> Float[Array, "..."]:
    """Weight, by the balance heuristic (Veach & Guibas 1995), of a direction drawn from the phase
    function when another one is drawn uniformly: p / (p + 1/(4 pi)) with the mean phase function;
    1 where nothing was scattered."""
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
    medium: Medium, walks: WalkBatch, vertex: Vertex, ahead: Flight, cosine: Array, density: Array
) -> tuple[Float[Array, "..."], Float[Array, "... wl"] | None]:
    """Scalar and spectral factors of a new direction drawn with `density` at `cosine`."""
    scalar = jnp.ones_like(walks.weight)
    spectral = walks.spectral
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


def population_control(
    medium: Medium,
    walks: WalkBatch,
    kept: int,
    u: Float[Array, " unit"],
    importance: Float[Array, "unit walk"] | float = 1.0,
) -> WalkBatch:
    """Roulette and splitting: `kept` of the walks of every unit, (unit, walk), drawn with
    probability proportional to their share of the light (the mean of all bands) times
    `importance`."""
    lanes_now = jax.lax.stop_gradient(walks)
    nowhere = tuple(jnp.zeros_like(s) for s in walks.lengths)
    value = lanes_now.weight[..., None] * attenuated(
        jax.lax.stop_gradient(medium), lanes_now, nowhere
    )
    tiny = jnp.finfo(value.dtype).tiny
    shares = value / jnp.maximum(jnp.sum(value, axis=1, keepdims=True), tiny)
    proposal_share = lanes_now.weight / jnp.maximum(
        jnp.sum(lanes_now.weight, axis=1, keepdims=True), tiny
    )
    # A tenth by the proposal's own weights, so that walks that matter to derivatives alone survive.
    return resample(
        walks,
        *systematic_resampling(
            (jnp.mean(shares, axis=2) + 0.1 * proposal_share) * importance, kept, u
        ),
    )


def systematic_resampling(
    importance: Float[Array, "unit walk"], kept: int, u: Float[Array, " unit"]
) -> tuple[Int[Array, "unit kept"], Float[Array, "unit kept"]]:
    """Systematic resampling of `kept` walks of every unit by importance: the indices drawn, in
    order, and the expected number of copies of each."""
    most = jnp.max(importance, axis=1, keepdims=True)
    importance = jnp.where(most > 0, importance / jnp.where(most > 0, most, 1.0), 1.0)
    upto = jnp.cumsum(importance, axis=1)
    whole = upto[:, -1:]
    # Draws from `starts[i]` on lie beyond walk i; a draw takes the walk whose index is the number
    # of walks that it lies beyond.
    starts = jnp.clip(jnp.ceil(upto / whole * kept - u[:, None]), 0, kept).astype(jnp.int32)
    passed = jax.vmap(lambda at: jnp.zeros(kept + 1, jnp.int32).at[at].add(1))(starts)
    walk = jnp.minimum(jnp.cumsum(passed, axis=1)[:, :kept], importance.shape[1] - 1)
    return walk, kept * jnp.take_along_axis(importance, walk, axis=1) / whole


def resample(
    walks: WalkBatch, walk: Int[Array, "unit kept"], copies: Float[Array, "unit kept"] | None
) -> WalkBatch:
    """The walks of the given indices, with weights that leave every expected value unchanged."""

    def take(leaf):
        index = walk.reshape(walk.shape + (1,) * (leaf.ndim - 2))
        return jnp.take_along_axis(leaf, index, axis=1)

    walks = jax.tree.map(take, walks)
    if copies is None:
        return walks
    # Rounding may choose a walk of importance 0 at the end of the row.
    there = copies > 0
    return walks._replace(weight=jnp.where(there, walks.weight / jnp.where(there, copies, 1.0), 0))


def flush_weights(medium: Medium, walks: WalkBatch) -> WalkBatch:
    """Walks whose lengths and counts have been moved into their spectral factor."""
    zero = jnp.zeros_like(walks.weight)
    nothing = (zero,) * len(walks.lengths)
    spectral = attenuated(medium, walks, nothing)
    return walks._replace(lengths=nothing, counts=nothing, floors=zero, spectral=spectral)


def similar(proposal: Proposal, medium: Medium) -> tuple[Proposal, Medium]:
    """A water that scatters isotropically with b (1 - g); far from boundaries its light is similar
    (similarity theory; Frisvad et al. 2007, section 3).  For walks with a spectral factor."""
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
