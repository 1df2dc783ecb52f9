"""Draws from the posterior, for fits whose ellipsoid at the optimum would mislead."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from fitting.core.diagnostics import SamplerDiagnostics, Status
from fitting.core.problem import AbstractProblem
from fitting.core.program_cache import cached_jit
from fitting.core.result import Fit, Quantity
from oceaninv.foundation.double_precision import in_double_precision

# Acceptance that the step is tuned to.
_TARGET = 0.8
# Chains that disagree by more than this (split R-hat) have not found the whole posterior.
_AGREE = 1.05


class NUTS(eqx.Module):
    """The no-U-turn sampler in coordinates whitened by the ellipsoid, then by a pilot round.

    - `draws`: of all chains together; `warm`: steps of warm-up in each of the two rounds;
      `chains`: side by side; `doublings`: of a trajectory at most.

    Cost: one gradient of the model per step of a trajectory.  The posterior of a photograph with
    few readings is a long, thin, curved ridge: steps are some 0.03 standard deviations, and a run
    takes minutes.

    Source: Hoffman & Gelman 2014, Betancourt 2017 (multinomial form), through blackjax (extra
    `mcmc`).
    """

    draws: int = eqx.field(static=True, default=400)
    warm: int = eqx.field(static=True, default=150)
    chains: int = eqx.field(static=True, default=8)
    doublings: int = eqx.field(static=True, default=6)


@in_double_precision
def sample(
    fit: Fit,
    *,
    key: Key[Array, ""] | None = None,
    sampler: NUTS = NUTS(),  # noqa: B008 (immutable)
) -> Fit:
    """The same fit with posterior draws instead of the ellipsoid at the optimum.

    **Arguments:**

    - `fit`: of photographs, or of a cast's constituents from its light alone.
    - `key`: of the random numbers; that of seed 0 unless given.
    - `sampler`: how many draws, chains and steps.

    **Returns** a `Fit` whose intervals are quantiles of the draws (`samples`), for derived
    quantities too, with medians as values; `sampling` holds the diagnostics, and the `status` is
    CHAINS_DISAGREE where split R-hat exceeds 1.05.
    """
    if fit.problem is None:
        raise ValueError(
            "this fit keeps no posterior to sample; those of photographs and of a cast's "
            "constituents (without a and c) do."
        )
    if sampler.draws < 32:
        raise ValueError(f"draws is {sampler.draws}; at least 32 are needed.")
    key = jax.random.key(0) if key is None else key
    return _by_nuts(fit, key, sampler)


def _by_nuts(fit: Fit, key, sampler: NUTS) -> Fit:
    try:
        import blackjax  # noqa: F401
    except ImportError:
        raise ValueError(
            "NUTS needs blackjax: pip install 'oceaninv[mcmc]', or do without sampling."
        ) from None
    problem, length = fit.problem, -(-sampler.draws // sampler.chains)
    first, second, begin = (jax.random.key_data(k) for k in jax.random.split(key, 3))
    centre, axes = jnp.asarray(fit.x), _root(fit.covariance)
    start = jax.random.normal(
        jax.random.wrap_key_data(begin), (sampler.chains, len(fit.x)), centre.dtype
    )
    pilot = _run(problem, centre, axes, start, first, sampler, sampler.warm)[0]
    flat = np.asarray(pilot).reshape(-1, len(fit.x))
    # The pilot draws are few: shrink their covariance towards that of the ellipsoid.
    spread = np.cov(flat.T) * 0.8 + 0.2 * np.asarray(fit.covariance)
    middle, new = flat.mean(axis=0), _root(spread)
    start = np.linalg.solve(np.asarray(new), (np.asarray(pilot)[:, -1] - middle).T).T
    chains, diverged, accepted = _run(
        problem, jnp.asarray(middle), new, jnp.asarray(start), second, sampler, length
    )
    chains = np.asarray(chains)
    rhat, effective = _diagnostics(chains)
    diagnostics = SamplerDiagnostics(
        "NUTS",
        chains.shape[0] * chains.shape[1],
        float(effective.min()),
        float(np.mean(accepted)),
        int(np.sum(diverged)),
        float(rhat.max()),
        fit.parameters.names[int(np.argmax(rhat))],
    )
    ended = fit.ended if rhat.max() < _AGREE else Status.CHAINS_DISAGREE
    return _posterior(fit, chains.reshape(-1, chains.shape[-1]), diagnostics, ended)


def _root(covariance) -> Array:
    covariance = np.asarray(covariance)
    unit = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return jnp.asarray(unit[:, None] * vectors * np.sqrt(np.maximum(values, 1e-12)))


def _run(problem, centre, axes, start, key, sampler: NUTS, length: int):
    # blackjax is not written for strict promotion.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        return _chains(problem, centre, axes, start, key, sampler, length)


@cached_jit
def _chains(problem: AbstractProblem, centre, axes, start, key, sampler: NUTS, length: int):
    """(chain, length, unknown) draws, (chain,) divergences and mean acceptance."""
    from blackjax.adaptation.step_size import dual_averaging_adaptation
    from blackjax.mcmc import nuts

    def log_density(u):
        residual = problem.residual(centre + axes @ u)
        value = -0.5 * jnp.sum(residual * residual)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    kernel: Callable = nuts.build_kernel()
    begin, update, _ = dual_averaging_adaptation(_TARGET)
    mass, warm = jnp.ones_like(centre), sampler.warm

    def chain(position, key):
        def step(carry, t):
            state, tuning = carry
            warming = t < warm
            chosen = jnp.where(warming, tuning.log_step_size, tuning.log_step_size_avg)
            state, info = kernel(
                jax.random.fold_in(key, t),
                state,
                log_density,
                jnp.exp(chosen),
                mass,
                sampler.doublings,
            )
            accepted = jnp.nan_to_num(info.acceptance_rate)
            tuned = update(tuning, accepted)
            tuning = jax.tree.map(lambda new, old: jnp.where(warming, new, old), tuned, tuning)
            return (state, tuning), (state.position, info.is_divergent, accepted)

        state = nuts.init(position, log_density)
        carry = (state, begin(0.3 * jnp.ones((), centre.dtype)))
        path, diverged, accepted = jax.lax.scan(step, carry, jnp.arange(warm + length))[1]
        kept_path = centre + path[warm:] @ axes.T
        return kept_path, jnp.sum(diverged[warm:]), jnp.mean(accepted[warm:])

    keys = jax.random.split(jax.random.wrap_key_data(key), start.shape[0])
    return jax.vmap(chain)(start, keys)


@cached_jit
def _push(problem: AbstractProblem, draws):
    return jax.lax.map(problem.quantities, draws, batch_size=50)


def _posterior(fit: Fit, draws: np.ndarray, diagnostics: SamplerDiagnostics, ended: Status) -> Fit:
    derived = _push(fit.problem, jnp.asarray(draws))
    quantities = {}
    for name, old in fit.quantities.items():
        values = np.asarray(derived[name])
        middle = np.asarray(np.median(values, axis=0))
        sd = np.asarray(np.std(np.log(values), axis=0))
        quantities[name] = Quantity(middle, sd, old.unit, old.long_name, values, kind=old.kind)
    return dataclasses.replace(
        fit,
        x=np.median(draws, axis=0),
        covariance=np.cov(draws.T),
        quantities=quantities,
        samples=draws,
        bias=None,
        second_order_sd=None,
        ended=ended,
        sampling=diagnostics,
    )


def _diagnostics(chains: np.ndarray):
    """(unknown,) split R-hat and effective numbers of draws.

    Source: Gelman et al. 2013, Bayesian Data Analysis, section 11.4-11.5, through blackjax.
    """
    from blackjax.diagnostics import effective_sample_size, potential_scale_reduction

    half = chains.shape[1] // 2
    split = np.concatenate([chains[:, :half], chains[:, half : 2 * half]])
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        rhat = potential_scale_reduction(jnp.asarray(split))
        effective = effective_sample_size(jnp.asarray(chains))
    return np.asarray(rhat), np.asarray(effective)
