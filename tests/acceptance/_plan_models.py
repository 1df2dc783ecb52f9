"""Error models of `plan`: fitted to random scenes, cross-validated, and their margins."""

import functools
from typing import NamedTuple

import numpy as np

from oceaninv.fidelity import error_model as errors
from oceaninv.fidelity import planning
from tests.acceptance import _plan_scenes as scenes

QUANTITIES = planning.QUANTITIES
TOLERANCES = (0.1, 0.03, 0.01)
# Least share of plans to be kept at each tolerance in scenes that a fit has not seen; the second
# where it costs no more than the first, by the median over the cheapest transport that does.
KEPT, FOLDS = (0.96, 0.985), 5
CENTRES, RIDGE = 240, 0.1
# Errors above what is expected weigh this much, those below it the rest: that an error passes
# through zero somewhere says little of its neighbours.
ABOVE, ROUNDS = 0.85, 12


def by_band(value, truth, quantity):
    """(scene, wl) errors of the bands."""
    relative = np.abs(value / truth - 1.0)
    if quantity == "irradiance":
        return relative.max(axis=1)
    if quantity == "radiance":
        return np.quantile(relative[:, : scenes.DIRECTIONS], 0.95, axis=1)
    seen, true = value[:, scenes.DIRECTIONS :], truth[:, scenes.DIRECTIONS :]
    return np.sqrt(np.mean((seen - true) ** 2, axis=1)) / true.mean(axis=1)


def key_of(quantity: str) -> str:
    """Photographs are made of radiance."""
    return "irradiance" if quantity == "irradiance" else "radiance"


class Sample:
    """One quantity of many scenes: features of their bands, and what each transport errs by."""

    def __init__(self, found, all_cases, quantity: str):
        key = key_of(quantity)
        self.cases = all_cases = all_cases[key]
        truth, lit, _ = found[key, planning.model_label(scenes.REFERENCES[key])]
        self.quantity = quantity
        self.names = [planning.model_label(r) for r in planning.CANDIDATES[quantity]]
        self.bands = [bands for *_, bands in all_cases]
        self.at = [errors.depths_of(bands, this, quantity, eye) for this, eye, bands in all_cases]
        self.rows = np.stack(
            [
                errors.features(bands, this, at)
                for (this, _, bands), at in zip(all_cases, self.at, strict=True)
            ]
        )
        self.use = lit if key == "radiance" else np.ones_like(lit)
        self.target, self.true, self.cost = {}, {}, {}
        # Models are made of all that was run; plans choose from the quantity's candidates.
        self.known = [planning.model_label(r) for r in scenes.RUNS[key]]
        for name in self.known:
            value, _, self.cost[name] = found[key, name]
            self.target[name] = np.log(by_band(value, truth, quantity) + errors.ERROR_FLOOR)
            self.true[name] = scenes.errors(value, truth, lit, quantity)

    def solve(self, name: str, training: np.ndarray) -> np.ndarray:
        """Coefficients of one transport from some of the scenes."""
        use = self.use & training[:, None]
        prior = _prior()
        x, y = self.rows[use] @ prior, self.target[name][use]
        weight, found = np.full(len(y), 0.5), np.zeros(x.shape[1])
        for _ in range(ROUNDS):  # an expectile
            weighted = x * weight[:, None]
            found = np.linalg.solve(weighted.T @ x + RIDGE * np.eye(len(found)), weighted.T @ y)
            weight = np.where(y > x @ found, ABOVE, 1.0 - ABOVE)
        return prior @ found

    def expected(self, i: int, coefficients: np.ndarray) -> float:
        """ln of what a scene is expected to err by, without a margin."""
        per_band = self.rows[i] @ coefficients
        seen = scenes.channels(i % 2)
        return errors.combine(per_band, self.bands[i], self.at[i], self.quantity, seen)

    def unseen(self, name: str) -> np.ndarray:
        """(scene,) the same from fits to the other folds."""
        fold = np.arange(len(self.rows)) % FOLDS
        parts = [self.solve(name, fold != k) for k in range(FOLDS)]
        return np.array([self.expected(i, parts[k]) for i, k in enumerate(fold)])


@functools.cache
def _prior() -> np.ndarray:
    """(feature, coordinate): coordinates of unit spread, in which the Gaussians are a process."""
    about = errors.centres()
    whole = errors.gaussians(about, about) + 1e-4 * np.eye(len(about))
    found = np.diag([3.0] + about.shape[1] * [0.5] + len(about) * [0.0])
    found[-len(about) :, -len(about) :] = np.linalg.inv(np.linalg.cholesky(whole)).T
    return found


def spread_centres(all_cases) -> np.ndarray:
    """(CENTRES, 9): of the bands of all scenes, each the one farthest from those before it."""
    rows = []
    for kind, quantity in (("irradiance", "irradiance"), ("radiance", "radiance")):
        for this, eye, bands in all_cases[kind]:
            at = errors.depths_of(bands, this, quantity, eye)
            rows.append(errors.cheap_numbers(bands, this, at))
    rows = np.concatenate(rows)
    picked = [rows[0]]
    distance = ((rows - picked[0]) ** 2).sum(axis=1)
    while len(picked) < CENTRES:
        picked.append(rows[np.argmax(distance)])
        distance = np.minimum(distance, ((rows - picked[-1]) ** 2).sum(axis=1))
    return np.array(picked)


def margins(sample: Sample) -> dict[str, float]:
    """By transport: a quantile of what errors exceed their expectation by, one share for all:
    see `KEPT`."""
    expected = {name: sample.unseen(name) for name in sample.known}
    found, price = {}, np.inf
    for share in np.linspace(0.6, 0.995, 80):
        now = quantiles(sample, expected, share)
        outcomes = [outcome(sample, expected, now, tolerance) for tolerance in TOLERANCES]
        kept = min(min(it.word, it.of_possible) for it in outcomes)
        cost = sum(it.own for it in outcomes)
        if not found and kept >= KEPT[0]:
            found, price = now, cost
        if kept >= KEPT[1]:
            return now if cost <= price else found
    return found


def quantiles(sample: Sample, expected, share: float) -> dict[str, float]:
    """By transport: what a share of the scenes' errors exceed their expectation by at most."""
    excess = {n: np.log(sample.true[n] + errors.ERROR_FLOOR) - e for n, e in expected.items()}
    return {n: float(np.quantile(e, share)) for n, e in excess.items()}


class Outcome(NamedTuple):
    """What became of plans: shares of promised plans that are kept, of plans that are promised,
    and of scenes in which some candidate keeps the tolerance that the chosen one does;
    cost over the cheapest candidate that does, median and mean, and over the cheapest of
    all that was tried, median."""

    word: float
    promised: float
    of_possible: float
    own: float
    mean: float
    every: float


def outcome(sample: Sample, expected, margin, tolerance: float) -> Outcome:
    """Of plans with these expectations and margins, by transport."""
    raised = np.stack([expected[n] + margin[n] for n in sample.names])
    promised = raised <= np.log(tolerance)
    some = promised.any(axis=0)
    chosen = np.where(some, np.argmax(promised, axis=0), np.argmin(raised, axis=0))
    return judged(sample, [sample.names[k] for k in chosen], some, tolerance)


def judged(sample: Sample, chosen: list[str], promised: np.ndarray, tolerance: float) -> Outcome:
    """Of one transport chosen for each scene."""
    kept = np.array([sample.true[n][i] <= tolerance for i, n in enumerate(chosen)])
    cost = np.array([sample.cost[name] for name in chosen])
    least = {}
    for names in (sample.names, sample.known):
        price = np.array([sample.cost[n] for n in names])[:, None]
        good = np.stack([sample.true[n] for n in names]) <= tolerance
        least[len(least)] = np.min(np.where(good, price, np.inf), axis=0)
    own, every = (cost[np.isfinite(v)] / v[np.isfinite(v)] for v in least.values())
    return Outcome(
        float(kept[promised].mean()) if promised.any() else 1.0,
        float(promised.mean()),
        float(kept[np.isfinite(least[0])].mean()),
        float(np.median(own)),
        float(own.mean()),
        float(np.median(every)),
    )


def fit(found, all_cases) -> dict[tuple[str, str], errors.ErrorModel]:
    """Error models of every transport."""
    models = {}
    for quantity in QUANTITIES:
        sample = Sample(found, all_cases, quantity)
        everything = np.ones(len(sample.rows), bool)
        for name, margin in margins(sample).items():
            coefficients = sample.solve(name, everything)
            models[quantity, name] = errors.ErrorModel(coefficients, margin, sample.cost[name])
    return models


def write(models) -> None:
    lines = [
        "# title: Errors of the candidate transports: coefficients of the features of a band",
        "# source: fitted to random scenes by python -m tests.acceptance.plan fit",
        "# columns: quantity, transport, margin (ln), seconds per scene, coefficients",
    ]
    for (quantity, transport), model in models.items():
        numbers = [f"{v:.6g}" for v in (model.margin, model.seconds, *model.coefficients)]
        lines.append(",".join([quantity, f'"{transport}"', *numbers]))
    errors.DATA.write_text("\n".join(lines) + "\n")


def write_centres(all_cases) -> None:
    """Before anything is fitted: features are made with them."""
    head = [
        "# title: Bands about which the Gaussians of the error models lie, in cheap numbers",
        "# source: spread over random scenes by python -m tests.acceptance.plan fit",
    ]
    rows = [",".join(f"{v:.4g}" for v in row) for row in spread_centres(all_cases)]
    errors.CENTRES.write_text("\n".join([*head, *rows]) + "\n")
    errors.centres.cache_clear()
