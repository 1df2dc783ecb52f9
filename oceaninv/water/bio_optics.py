"""Bio-optical models: from dissolved and suspended constituents to inherent optical properties."""

import abc
import difflib
import functools
import warnings
from collections.abc import Iterable, Sequence

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, ScalarLike

from oceaninv.foundation import tables
from oceaninv.foundation.numerics import safe_power
from oceaninv.water import pure_water
from oceaninv.water.iops import IOPs, check_concrete, check_scalar
from oceaninv.water.phase import (
    AbstractPhase,
    FournierForand,
    Isotropic,
    Mixture,
    Seawater,
    fit_two_term,
    petzold,
)


class Constituents(eqx.Module):
    """How much of each constituent the water holds.  `None` is absent, not zero.

    **Arguments:**

    - `chlorophyll`: mg/m3.
    - `cdom`: absorption by coloured dissolved organic matter at 440 nm, 1/m.
    - `detritus`: absorption by organic detritus at 400 nm, 1/m.
    - `minerals`: suspended minerals, g/m3.
    - further constituents by name, for models that have them.

    Negative concrete amounts, vectors and misspelt names raise ValueError.

    >>> float(Constituents(chlorophyll=2.0, cdom=0.1).chlorophyll)
    2.0
    """

    amounts: dict[str, Float[Array, ""]]

    def __init__(self, chlorophyll=None, cdom=None, detritus=None, minerals=None, **others):
        named = {
            "chlorophyll": chlorophyll,
            "cdom": cdom,
            "detritus": detritus,
            "minerals": minerals,
            **others,
        }
        _check_spelling(others)
        present = {name: value for name, value in named.items() if value is not None}
        for name, value in present.items():
            check_scalar(name, value)
            check_concrete(name, value)
        self.amounts = {
            name: jnp.asarray(value, dtype=jnp.result_type(float, value))
            for name, value in present.items()
        }

    def __getitem__(self, name: str) -> Float[Array, ""]:
        return self.amounts[name]

    def __getattr__(self, name: str) -> Float[Array, ""]:
        """The amount of a constituent; AttributeError where the water holds none."""
        # Asked for what is no field: while a copy is being made, "amounts" may not be there yet.
        amounts = self.__dict__.get("amounts", {})
        if name in amounts:
            return amounts[name]
        held = ", ".join(amounts) or "none"
        raise AttributeError(f"these Constituents hold no {name!r}; they hold {held}.")


def _check_spelling(names: Iterable[str]) -> None:
    """ValueError for names that look like one of the four and are not."""
    known = ("chlorophyll", "cdom", "detritus", "minerals")
    for name in names:
        plain = name.lower()
        short = [entry for entry in known if entry.startswith(plain)]
        near = short or difflib.get_close_matches(plain, known, cutoff=0.75)
        # "detritus_2" may be a constituent of its own.
        if near and (plain in known or near[0] not in plain):
            raise ValueError(
                f"constituent {name!r} is unknown. Near it: {near[0]}. A constituent of your own "
                "needs a name that differs more."
            )


_SHAPES = (0.004, 0.05)


def particle_phase(backscatter_ratio: ScalarLike) -> Mixture:
    """Phase function of natural particles with a given bb/b, 0.004 to 0.05.

    A mixture of two fixed Fournier-Forand functions (bb/b = 0.004 and 0.05): one shape less to
    compute per constituent, and differentiable in the ratio at no cost.  Ratios outside the
    range take the nearer end.
    """
    low, high = _SHAPES
    share = jnp.clip((jnp.asarray(backscatter_ratio, dtype=float) - low) / (high - low), 0.0, 1.0)
    return Mixture(jnp.stack([1.0 - share, share]), _particle_shapes())


@functools.cache
def _particle_shapes() -> tuple[AbstractPhase, ...]:
    with jax.ensure_compile_time_eval():
        return tuple(FournierForand(ratio) for ratio in _SHAPES)


def _shapes(phase: AbstractPhase):
    """(weight, fixed shape) of a phase function; a lone shape has weight None."""
    if isinstance(phase, Mixture):
        return list(zip(phase.weights, phase.phases, strict=True))
    return [(None, phase)]


class AbstractConstituent(eqx.Module):
    """A constituent of the water.  Write one to add one: a name, a, b and a phase function.

    `name` is the keyword of `Constituents` that carries its amount.  `absorption` and
    `scattering` return (wl,) in 1/m, or None where the constituent has none; `phase` is then
    needed only if it scatters.
    """

    name: eqx.AbstractVar[str]
    phase: eqx.AbstractVar[AbstractPhase | None]

    @abc.abstractmethod
    def absorption(
        self, amount: Float[Array, ""], wavelength: np.ndarray
    ) -> Float[Array, " wl"] | None:
        """Absorption coefficient, 1/m."""

    @abc.abstractmethod
    def scattering(
        self, amount: Float[Array, ""], wavelength: np.ndarray
    ) -> Float[Array, " wl"] | None:
        """Scattering coefficient, 1/m."""


def _exponential(amount, slope, wavelength, reference) -> Array:
    distance = jnp.asarray(wavelength - reference, dtype=amount.dtype)
    return amount * jnp.exp(-slope * distance)


def _power(amount, exponent, wavelength, reference) -> Array:
    logs = jnp.asarray(np.log(reference / wavelength), dtype=amount.dtype)
    return amount * jnp.exp(exponent * logs)


class Phytoplankton(AbstractConstituent):
    """Living algae, by chlorophyll concentration C (mg/m3).

    Absorption A(wl) C^E(wl) of Bricaud et al. 1998 (400-700 nm; J. Geophys. Res. 103:31033);
    scattering 0.30 C^0.62 (550/wl) of Gordon & Morel 1983.  Value and slope stay finite at C = 0.

    - `absorption_scale`: multiplies the absorption (species and packaging vary it by about 1.5).
    - `scattering_at_550`: scattering coefficient at 550 nm for C = 1, 1/m.
    - `exponent`: scattering falls as wl^-exponent; 1 in Gordon & Morel 1983, from 1 in clear water
      to 0 above 2 mg/m3 in Morel & Maritorena 2001.
    - `extension`: `None` raises ValueError outside 400-700 nm; "Sathyendranath1987" continues
      with the shape of Sathyendranath, Lazzara & Prieur 1987 (380-780 nm), uncertain by about
      30 % below 400 nm, where mycosporine-like pigments are not modelled.
    """

    absorption_scale: ScalarLike = 1.0
    scattering_at_550: ScalarLike = 0.30
    exponent: ScalarLike = 1.0
    phase: AbstractPhase | None = eqx.field(default_factory=lambda: particle_phase(0.010))
    extension: str | None = eqx.field(static=True, default=None)
    name: str = eqx.field(static=True, default="chlorophyll")

    def absorption(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        if self.extension not in (None, "Sathyendranath1987"):
            raise tables.unknown("extension", self.extension, ["Sathyendranath1987"])
        table = tables.load("Bricaud1998")
        inside, place = wavelength, np.arange(len(wavelength))
        if self.extension is not None:
            ends = table.wavelength[0], table.wavelength[-1]
            # Several bands may lie beyond the same end; a table is read once at each wavelength.
            inside, place = np.unique(np.clip(wavelength, *ends), return_inverse=True)
        scale, exponent = table.at(inside, "A_phi")[place], table.at(inside, "E_phi")[place]
        if self.extension is not None:
            shape = tables.load("Gutierrez2008")
            beyond = shape.at(wavelength, "a_phytoplankton")
            scale = scale * beyond / shape.at(inside, "a_phytoplankton")[place]
        dtype = amount.dtype
        power = safe_power(jnp.broadcast_to(amount, wavelength.shape), jnp.asarray(exponent, dtype))
        return jnp.multiply(self.absorption_scale, jnp.asarray(scale, dtype) * power)

    def scattering(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        power = safe_power(amount, jnp.asarray(0.62, amount.dtype))
        at_550 = jnp.multiply(self.scattering_at_550, power)
        return _power(at_550, self.exponent, wavelength, 550.0)


class CDOM(AbstractConstituent):
    """Coloured dissolved organic matter, by its absorption at 440 nm (1/m).

    a(wl) = amount exp(-slope (wl - 440)), Bricaud, Morel & Prieur 1981; the default slope
    0.0176 /nm is the European coastal mean of Babin et al. 2003.  It does not scatter.
    """

    slope: ScalarLike = 0.0176
    phase: AbstractPhase | None = None
    name: str = eqx.field(static=True, default="cdom")

    def absorption(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return _exponential(amount, self.slope, wavelength, 440.0)

    def scattering(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return None


class Detritus(AbstractConstituent):
    """Organic detritus, by its absorption at 400 nm (1/m).

    a(wl) = amount exp(-slope (wl - 400)), slope 0.0123 /nm (Babin et al. 2003);
    b(wl) = scattering_ratio amount (400/wl)^exponent.

    - `scattering_ratio`: scattering-to-absorption ratio b_d/a_d(400).  It alone separates detritus
      from CDOM.  Measured values scatter by a factor of 2 about 5; fits treat it as a nuisance.
    - `exponent`: 0.9, the decline of scattering in Stramski et al. 2001.
    """

    slope: ScalarLike = 0.0123
    scattering_ratio: ScalarLike = 5.0
    exponent: ScalarLike = 0.9
    phase: AbstractPhase | None = eqx.field(default_factory=lambda: particle_phase(0.018))
    name: str = eqx.field(static=True, default="detritus")

    def absorption(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return _exponential(amount, self.slope, wavelength, 400.0)

    def scattering(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return _power(jnp.multiply(self.scattering_ratio, amount), self.exponent, wavelength, 400.0)


class Minerals(AbstractConstituent):
    """Suspended minerals, by mass concentration (g/m3).

    Absorption 0.041 m2/g at 443 nm with slope 0.0123 /nm (Babin et al. 2003, J. Geophys. Res.
    108:3211); scattering 0.51 m2/g at 555 nm (Babin et al. 2003, Limnol. Oceanogr. 48:843),
    falling as wl^-0.3.
    """

    specific_absorption: ScalarLike = 0.041
    slope: ScalarLike = 0.0123
    specific_scattering: ScalarLike = 0.51
    exponent: ScalarLike = 0.3
    phase: AbstractPhase | None = eqx.field(default_factory=lambda: particle_phase(0.020))
    name: str = eqx.field(static=True, default="minerals")

    def absorption(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return _exponential(
            jnp.multiply(self.specific_absorption, amount), self.slope, wavelength, 443.0
        )

    def scattering(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return _power(
            jnp.multiply(self.specific_scattering, amount), self.exponent, wavelength, 555.0
        )


class TabulatedPhytoplankton(AbstractConstituent):
    """Chlorophyll times the specific absorption of Sathyendranath, Lazzara & Prieur 1987
    (380-780 nm, as sampled in Gutierrez et al. 2008, table 1), scattering of their eq 11."""

    phase: AbstractPhase | None = eqx.field(default_factory=Isotropic)
    name: str = eqx.field(static=True, default="chlorophyll")

    def absorption(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        specific = tables.load("Gutierrez2008").at(wavelength, "a_phytoplankton")
        return amount * jnp.asarray(specific, amount.dtype)

    def scattering(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return Phytoplankton().scattering(amount, wavelength)


class TabulatedDetritus(AbstractConstituent):
    """Detritus and minerals together as in Gutierrez et al. 2008: eq 8 with slope 0.011 /nm, and
    the scattering spectrum of their table 2 (total) for an absorption of 0.1 /m at 400 nm.

    The paper prints that spectrum without relating it to the absorption; here it scales with the
    amount, so that water without detritus has no detritus scattering.
    """

    phase: AbstractPhase | None = eqx.field(default_factory=lambda: fit_two_term(petzold()))
    name: str = eqx.field(static=True, default="detritus")

    def absorption(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        return _exponential(amount, 0.011, wavelength, 400.0)

    def scattering(self, amount: Float[Array, ""], wavelength: np.ndarray) -> Array | None:
        table = tables.load("Gutierrez2008")
        total = table.at(wavelength, "b_detritus") + table.at(wavelength, "b_minerals")
        return amount / 0.1 * jnp.asarray(total, amount.dtype)


class BioOpticalModel(eqx.Module):
    """Pure water plus any number of constituents.

    **Arguments:**

    - `constituents`: the constituents of the model; the default is `Phytoplankton()`,
      `CDOM()`, `Detritus()`, `Minerals()`.
    - `water_absorption`, `water_scattering`: sources by author and year, see
      `oceaninv.water.absorption` and `oceaninv.water.scattering`.
    - `temperature` (deg C), `salinity`: of the water.  `None` takes absorption as its table has
      it (IOCCG 2018 gives no salinity slope below 400 nm) and scattering of sea water at 20 deg C
      and salinity 35.

    >>> model = BioOpticalModel()
    >>> model.iops(Constituents(chlorophyll=1.0, cdom=0.1), [450.0, 550.0]).a.shape
    (2,)
    """

    constituents: tuple[AbstractConstituent, ...]
    water_absorption: str = eqx.field(static=True)
    water_scattering: str = eqx.field(static=True)
    temperature: float | None = eqx.field(static=True)
    salinity: float | None = eqx.field(static=True)

    def __init__(
        self,
        constituents: Sequence[AbstractConstituent] | None = None,
        water_absorption: str = "IOCCG2018",
        water_scattering: str = "Zhang2009",
        temperature: float | int | None = None,
        salinity: float | int | None = None,
    ):
        if constituents is None:
            constituents = (Phytoplankton(), CDOM(), Detritus(), Minerals())
        self.constituents = tuple(constituents)
        self.water_absorption = water_absorption
        self.water_scattering = water_scattering
        self.temperature = temperature
        self.salinity = salinity

    def iops(self, constituents: Constituents, wavelength) -> IOPs:
        """Optical properties of water that holds `constituents`, in the dtype of the amounts.

        `wavelength`: (wl,) nm, concrete.  A constituent that the model does not know, or a
        wavelength outside the tables that are in use, raises ValueError.
        """
        wavelength = tables.check_wavelength(wavelength)
        known = {constituent.name: constituent for constituent in self.constituents}
        for name in constituents.amounts:
            if name not in known:
                raise tables.unknown("constituent", name, sorted(known))
        amounts = list(constituents.amounts.values())
        dtype = jnp.result_type(*amounts) if amounts else jnp.result_type(float)
        pure_a = pure_water.absorption(
            wavelength, self.water_absorption, self.temperature, self.salinity
        )
        pure_b = pure_water.scattering(
            wavelength,
            self.water_scattering,
            20.0 if self.temperature is None else self.temperature,
            35.0 if self.salinity is None else self.salinity,
        )
        a_rows, b_rows = [jnp.asarray(pure_a, dtype)], [jnp.asarray(pure_b, dtype)]
        shapes: list[AbstractPhase] = [Seawater(pure_water.phase_constant(self.water_scattering))]
        absorbers, scatterers = ["water"], ["water"]
        for name, constituent in known.items():
            if name not in constituents.amounts:
                continue
            amount = constituents.amounts[name]
            a = constituent.absorption(amount, wavelength)
            b = constituent.scattering(amount, wavelength)
            if a is not None:
                a_rows.append(a)
                absorbers.append(name)
            if b is None:
                continue
            if constituent.phase is None:
                raise ValueError(f"constituent {name!r} scatters but has no phase function.")
            for weight, shape in _shapes(constituent.phase):
                share = b if weight is None else weight.astype(b.dtype) * b
                # Constituents that share a shape share a row: each shape is evaluated once.
                row = next((i for i, s in enumerate(shapes) if s is shape), None)
                if row is None:
                    b_rows.append(share)
                    shapes.append(shape)
                    scatterers.append(name)
                else:
                    b_rows[row] = b_rows[row] + share
                    scatterers[row] += f"+{name}"
        return IOPs(
            wavelength, jnp.stack(a_rows), jnp.stack(b_rows), tuple(shapes), absorbers, scatterers
        )


def gutierrez2008() -> BioOpticalModel:
    """The model of Gutierrez et al. 2008 as printed, to reproduce its figures.

    Smith & Baker 1981 absorption and Morel 1974 scattering of pure sea water, CDOM slope 0.014,
    isotropic phytoplankton scattering (its 1/pi read as 1/(4 pi)), detritus with a two-term
    Henyey-Greenstein function whose unprinted parameters are fitted to Petzold's average.
    """
    return BioOpticalModel(
        (TabulatedPhytoplankton(), CDOM(slope=0.014), TabulatedDetritus()),
        water_absorption="SmithBaker1981",
        water_scattering="Morel1974",
    )


JERLOV_SOURCES = ("SolonenkoMobley2015", "WilliamsonHollins2022")
_FLAGGED_A, _FLAGGED_B = 8, 16


def jerlov_types(source: str = "SolonenkoMobley2015") -> tuple[str, ...]:
    """The Jerlov water types that a source tabulates."""
    if source not in JERLOV_SOURCES:
        raise tables.unknown("source", source, JERLOV_SOURCES)
    columns = tables.load(source).columns
    return tuple(name[2:] for name in columns if name.startswith("a_"))


def jerlov(
    type: str, wavelength, source: str = "SolonenkoMobley2015", phase: AbstractPhase | None = None
) -> IOPs:
    """Optical properties of a Jerlov water type: sea water and particles.

    **Arguments:**

    - `type`: "I", "IA", "IB", "II", "III" (ocean), "1C" ... "9C" (coast).
    - `wavelength`: (wl,) nm, concrete, inside the table.
    - `source`: "SolonenkoMobley2015" (all ten types, 300-700 nm) or "WilliamsonHollins2022"
      (IB to 5C, 300-800 nm; measured 412-715 nm).  The tables' a and b do not close with Jerlov's
      Kd in the blue of coastal types.
    - `phase`: phase function of the particles; Petzold's average unless given.

    b is divided as by `measured_iops`.  The table's b of type I is up to 12 % below that of pure
    sea water (Zhang, Hu & He 2009) from 300 to 550 nm, which no sea is: there sea water's is taken,
    and no particles.

    **Raises:** `ValueError` for an unknown type or a wavelength that the table lacks.  Values that
    the source marks as doubtful, and b that was raised to sea water's, are named in a UserWarning.

    >>> water = jerlov("IB", [450.0])
    >>> [round(float(b), 5) for b in water.b_components[:, 0]]
    [0.00398, 0.06402]
    """
    wavelength = tables.check_wavelength(wavelength)
    types = jerlov_types(source)
    if type not in types:
        raise tables.unknown("Jerlov water type", type, types)
    table = tables.load(source)
    a, b = table.at(wavelength, f"a_{type}"), table.at(wavelength, f"b_{type}")
    remarks = []
    flags = table.columns.get(f"flag_{type}")
    if flags is not None:
        near = np.abs(table.wavelength[:, None] - wavelength[None, :]).argmin(axis=0)
        marked = flags[near].astype(int)
        doubtful = [
            name for name, bit in (("a", _FLAGGED_A), ("b", _FLAGGED_B)) if np.any(marked & bit)
        ]
        if doubtful:
            remarks.append(f"{source} marks {' and '.join(doubtful)} of type {type} as doubtful.")
    molecules = pure_water.scattering(wavelength)
    low = b < molecules
    if low.any():
        remarks.append(
            f"b of type {type} in {source} is below that of pure sea water in {int(low.sum())} of "
            f"{low.size} bands (first at {wavelength[low][0]:g} nm): sea water's is taken there."
        )
    if remarks:
        warnings.warn(" ".join(remarks), stacklevel=2)
    return measured_iops(wavelength, a, np.maximum(b, molecules), phase)


def measured_iops(wavelength, a, b, phase: AbstractPhase | None = None) -> IOPs:
    """Optical properties of sea water whose total a and b were measured.

    **Arguments:**

    - `wavelength`: (wl,) nm, concrete, 300 to 800.
    - `a`, `b`: (wl,) absorption and scattering of sea water and all that it holds, 1/m.
    - `phase`: phase function of the particles; Petzold's average unless given.

    Of b, the part that pure sea water scatters (Zhang, Hu & He 2009, 20 deg C, salinity 35) has
    its own phase function, half of it backwards; the rest is particles'.  This matters in clear
    water: at 412 nm in type IA of Jerlov it is two thirds of b and 98 % of bb.  Where b is below
    sea water's, all of it is sea water's, and a UserWarning says so.  For b with one phase function
    use `IOPs`.

    **Raises:** `ValueError` for coefficients that are negative, not finite or not one per
    wavelength, and for wavelengths out of range.

    >>> water = measured_iops([450.0, 550.0], [0.02, 0.06], [0.1, 0.08])
    >>> water.scatterers
    ('water', 'particles')
    """
    wavelength = tables.check_wavelength(wavelength)
    b = jnp.asarray(b)
    b = b.astype(jnp.result_type(float, b))
    if b.shape != wavelength.shape:
        raise ValueError(
            f"b must have shape {wavelength.shape} to match wavelength, not {b.shape}."
        )
    check_concrete("b", b)
    molecules = pure_water.scattering(wavelength)
    if not isinstance(b, jax.core.Tracer):
        # Not for rounding: b may be sea water's own.
        low = np.asarray(b) < (1 - 1e-6) * molecules
        if low.any():
            warnings.warn(
                f"b is below that of pure sea water in {int(low.sum())} of {low.size} bands (first "
                f"at {wavelength[low][0]:g} nm): all of it is taken as sea water's.",
                stacklevel=2,
            )
    molecules = jnp.asarray(molecules, b.dtype)
    rows = jnp.stack([jnp.minimum(b, molecules), jnp.maximum(b - molecules, 0.0)])
    shapes = (Seawater(pure_water.phase_constant()), petzold() if phase is None else phase)
    return IOPs(wavelength, jnp.asarray(a), rows, shapes, scatterers=("water", "particles"))
