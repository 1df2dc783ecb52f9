"""How a fit ended, and what is known about how it was found."""

import dataclasses
import enum


class Status(enum.IntEnum):
    """How a search or a sampler ended; each status has a `message`.

    The values are the codes that compiled programs return: `code == Status.CONVERGED` compares
    arrays of codes, and `Status(int(code))` is the status of one.
    """

    message: str

    def __new__(cls, code: int, message: str):
        member = int.__new__(cls, code)
        member._value_ = code
        member.message = message
        return member

    CONVERGED = 0, "converged"
    STEP_LIMIT = (
        1,
        "the step limit was reached before the optimum: the data hardly constrain some unknown; "
        "add data or prior knowledge, or raise max_steps",
    )
    MODEL_NOT_FINITE = (
        2,
        "the model is not finite where the search ended: check units, depths and prior centres",
    )
    NUMBERS_NOT_FINITE = (
        3,
        "the search converged, but some numbers of the fit are not finite: the data do not "
        "determine them",
    )
    CHAINS_DISAGREE = (
        4,
        "the chains of the sampler disagree: ask for more draws or give prior knowledge",
    )
    OUTSIDE_MODEL = (
        5,
        "the search converged, but at a water that the model of the light does not describe (some "
        "derived number is negative): check the data, or take a more accurate transport",
    )


@dataclasses.dataclass(frozen=True)
class ModelChoice:
    """Which transport a fit within a tolerance chose, and how it was corrected.

    - `transport`: the chosen one; `tried`: all that were fitted with, in order.
    - `tolerance`: the largest relative error asked for; `predicted_error`: that of the chosen
      transport, for the water found.
    - `corrections`: how many searches with a correction by an accurate model followed;
      `corrected_by`: that model, None without corrections.
    - `largest_correction`: largest relative difference between the two models at the optimum.
    - `remaining_error`: relative error of the model that remains after the corrections.
    - `settled`: whether the unknowns had settled at the end of the corrections, where that is
      checked; else None.
    """

    transport: str
    tried: tuple[str, ...]
    tolerance: float
    predicted_error: float
    corrections: int = 0
    corrected_by: str | None = None
    largest_correction: float | None = None
    remaining_error: float | None = None
    settled: bool | None = None

    @property
    def within_tolerance(self) -> bool:
        """Whether the model's error, after corrections, is within the tolerance."""
        error = self.predicted_error if self.remaining_error is None else self.remaining_error
        return error <= self.tolerance

    def facts(self) -> dict:
        """The fields that are known, for files."""
        known = {k: v for k, v in dataclasses.asdict(self).items() if v is not None}
        return known | {"within_tolerance": self.within_tolerance}


@dataclasses.dataclass(frozen=True)
class SamplerDiagnostics:
    """How well a sampler's chains represent the posterior.

    - `sampler`: its name; `draws`: of all chains; `effective_draws`: the least effective number
      of independent draws among the unknowns.
    - `acceptance`: mean acceptance probability; `diverging_trajectories`: how many diverged.
    - `largest_split_rhat`: the largest split R-hat (1: the chains agree); `least_agreed`: the
      unknown that has it.
    """

    sampler: str
    draws: int
    effective_draws: float
    acceptance: float
    diverging_trajectories: int
    largest_split_rhat: float
    least_agreed: str
