"""Pure water and pure sea water: absorption and molecular scattering."""

import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyval

from oceaninv.foundation import tables

# Tables with slopes, and the temperature (degC) that theirs start from; all start at fresh water.
_WITH_SLOPES = {"IOCCG2018": 22.0, "WOPPv3": 20.0}
# Tables without, and the condition at which they hold; natural waters as they are have none.
_FIXED = {"PopeFry1997": {"temperature": 22.0, "salinity": 0.0}, "SmithBaker1981": {}}
_TEMPERATURES = (0.0, 30.0)
_SALINITIES = (0.0, 40.0)

_DEPOLARISATION = 0.039  # Farinato & Rowell 1976, as used by Zhang, Hu & He 2009
_PHASE_CONSTANTS = {
    "Zhang2009": (1 - _DEPOLARISATION) / (1 + _DEPOLARISATION),
    "Morel1974": 0.835,  # a depolarisation of 0.09
}


def absorption(
    wavelength: tables.Wavelengths,
    source: str = "IOCCG2018",
    temperature: float | int | None = None,
    salinity: float | int | None = None,
) -> Float[np.ndarray, " wl"]:
    """Absorption coefficient of pure water or pure sea water, 1/m.

    **Arguments:**

    - `wavelength`: nm, concrete, within the table (never extrapolated).
    - `source`: "IOCCG2018" (300-800 nm), "WOPPv3" (300-800 nm), "PopeFry1997" (380-727.5 nm) or
      "SmithBaker1981" (200-800 nm: clearest natural waters, an upper bound below 420 nm).
    - `temperature`: degC, 0 to 30. None: the table's own.
    - `salinity`: practical, 0 to 40. None: the table's own (fresh water).

    The first two tables have slopes with temperature and salinity (linear, from 22 and 20 degC
    and from fresh water). Pope & Fry measured fresh water at 22 degC and gave no slopes, so
    that no other condition is accepted. Smith & Baker summarise natural waters, fresh and salt, and
    state no condition: their table serves all. IOCCG 2018 gives no salinity slope below 400 nm:
    there it needs `salinity=0`.

    **Raises:** `ValueError` for an unknown source, a wavelength outside the table, a condition
    out of range or one that the table cannot be taken to.

    Source: the header of each table (`oceaninv.tables.load(source).citation`).

    >>> absorption([440.0, 550.0], "PopeFry1997")
    array([0.00635, 0.0565 ])
    >>> absorption([440.0, 550.0], temperature=22.0, salinity=10.0)
    array([0.00657, 0.05663])
    """
    if source in _FIXED:
        _condition(temperature, salinity)
        _refuse_other_condition(source, temperature=temperature, salinity=salinity)
        return tables.load(source).at(wavelength, "a")
    if source not in _WITH_SLOPES:
        raise tables.unknown("Source of water absorption", source, [*_WITH_SLOPES, *_FIXED])
    table = tables.load(source)
    temperature = _WITH_SLOPES[source] if temperature is None else temperature
    temperature, salinity = _condition(temperature, 0.0 if salinity is None else salinity)
    a = table.at(wavelength, "a")
    a = a + (temperature - _WITH_SLOPES[source]) * table.at(wavelength, "a_temperature")
    if salinity == 0:
        return a
    try:
        slope = table.at(wavelength, "a_salinity")
    except ValueError as error:
        raise ValueError(f"{error} Ask for salinity=0 or for another source.") from None
    return a + salinity * slope


def scattering(
    wavelength: tables.Wavelengths,
    source: str = "Zhang2009",
    temperature: float | int = 20.0,
    salinity: float | int = 35.0,
) -> Float[np.ndarray, " wl"]:
    """Scattering coefficient of pure water or pure sea water, 1/m.

    **Arguments:**

    - `wavelength`: nm, concrete, 300 to 800.
    - `source`: "Zhang2009" (density and concentration fluctuations) or "Morel1974"
      (b = 0.00288 (500/wavelength)^4.32 for sea water of salinity 35 to 39, 0.00222 for fresh
      water, linear in between; within 0.5 % of his table up to 525 nm, 3 % below it at 575 nm and
      7 % at 600 nm, where it ends). In sea water the first is 7 to 13 % below the second.
    - `temperature`: degC, 0 to 30; Morel1974: 20 only.
    - `salinity`: practical, 0 to 40; Morel1974 0 to 39.

    **Raises:** `ValueError` for an unknown source or anything out of range.

    Sources: Zhang, Hu & He 2009, Optics Express 17:5698, doi:10.1364/OE.17.005698; Morel 1974,
    in Optical Aspects of Oceanography. Half of the light is scattered backwards: the phase
    function of `phase_constant` is even in the cosine.

    >>> float(scattering([500.0])[0].round(7))
    0.0025473
    """
    if source not in _PHASE_CONSTANTS:
        raise tables.unknown("Source of water scattering", source, _PHASE_CONSTANTS)
    wavelength = tables.check_wavelength(wavelength)
    if wavelength[0] < 300 or wavelength[-1] > 800:
        raise ValueError(
            "Water scattering covers 300-800 nm, but the wavelengths run from"
            f" {wavelength[0]:g} to {wavelength[-1]:g} nm."
        )
    temperature, salinity = _condition(temperature, salinity)
    if source == "Zhang2009":
        ninety = _zhang2009_at_90_degrees(wavelength, temperature, salinity)
        return ninety * 4 * np.pi * (1 + phase_constant(source) / 3)
    if temperature != 20.0 or salinity > 39.0:
        raise ValueError(
            "Morel1974 holds at 20 degC and a salinity of 0 to 39, but came with"
            f" temperature={temperature:g}, salinity={salinity:g}: take Zhang2009."
        )
    at_500 = 0.00222 + (0.00288 - 0.00222) * min(salinity / 35.0, 1.0)
    return at_500 * (500.0 / wavelength) ** 4.32


def phase_constant(source: str = "Zhang2009") -> float:
    """k of the phase function 3 (1 + k cos^2)/(4 pi (3 + k)) of water, in 1/sr.

    (1 - d)/(1 + d) with the depolarisation d = 0.039 for "Zhang2009"; 0.835 for "Morel1974".

    >>> round(phase_constant(), 6)
    0.924928
    """
    if source not in _PHASE_CONSTANTS:
        raise tables.unknown("Source of water scattering", source, _PHASE_CONSTANTS)
    return _PHASE_CONSTANTS[source]


def _refuse_other_condition(source: str, **asked: float | int | None) -> None:
    """ValueError for a condition that differs from that of a table without slopes."""
    for name, own in _FIXED[source].items():
        value = asked[name]
        if value is not None and value != own:
            raise ValueError(
                f"{source} holds only at its own {name}, {own:g}, but {name}={value:g} was asked"
                f" for: leave {name} out, or take a source with slopes"
                f" ({', '.join(_WITH_SLOPES)})."
            )


def _condition(
    temperature: float | int | None, salinity: float | int | None
) -> tuple[float, float]:
    """Temperature and salinity with their defaults, in range."""
    temperature = 20.0 if temperature is None else float(temperature)
    salinity = 35.0 if salinity is None else float(salinity)
    for name, value, (low, high), unit in (
        ("temperature", temperature, _TEMPERATURES, " degC"),
        ("salinity", salinity, _SALINITIES, ""),
    ):
        if not low <= value <= high:
            raise ValueError(f"{name} must lie in {low:g} to {high:g}{unit}, but is {value:g}.")
    return temperature, salinity


def _zhang2009_at_90_degrees(wavelength: np.ndarray, t: float, s: float) -> np.ndarray:
    """Volume scattering at 90 degrees, 1/m/sr: density plus concentration fluctuations."""
    boltzmann, avogadro, molar_mass = 1.3806503e-23, 6.0221417930e23, 18e-3
    n, dn_ds = _refractive_index(wavelength, t, s)
    cabannes = (6 + 6 * _DEPOLARISATION) / (6 - 7 * _DEPOLARISATION)
    front = np.pi**2 / 2 * (wavelength * 1e-9) ** -4 * cabannes
    # (rho dn^2/drho)^2 after Proutiere, Megnassan & Hucteau 1992.
    n2 = n**2
    density_slope = (n2 - 1) * (1 + 2 / 3 * (n2 + 2) * ((n - 1 / n) / 3) ** 2)
    density = boltzmann * (t + 273.15) * _compressibility(t, s) * density_slope**2
    salt = s * molar_mass * dn_ds**2 / (_density(t, s) * -_activity_slope(t, s) * avogadro)
    return front * (density + 4 * n2 * salt)


def _refractive_index(wavelength: np.ndarray, t: float, s: float) -> tuple[np.ndarray, np.ndarray]:
    """Index of sea water against vacuum and its slope with salinity.

    Quan & Fry 1995 (Applied Optics 34:3477) against air, times air of Ciddor 1996.
    """
    square = (wavelength / 1e3) ** -2
    air = 1 + (5792105 / (238.0185 - square) + 167917 / (57.362 - square)) / 1e8
    slope = polyval(t, [1.779e-4, -1.05e-6, 1.6e-8]) + 0.01155 / wavelength
    fresh = 1.31405 - 2.02e-6 * t**2 + polyval(1 / wavelength, [0, 15.868, -4382, 1.1455e6])
    return air * (fresh - 0.00423 * t / wavelength + slope * s), air * slope


def _compressibility(t: float, s: float) -> float:
    """Isothermal compressibility at atmospheric pressure, 1/Pa (Millero et al. 1980)."""
    fresh = polyval(t, [19652.21, 148.4206, -2.327105, 1.360477e-2, -5.155288e-5])
    linear = polyval(t, [54.6746, -0.603459, 1.09987e-2, -6.167e-5])
    root = polyval(t, [7.944e-2, 1.6483e-2, -5.3009e-4])
    return 1e-5 / (fresh + linear * s + root * s**1.5)


def _density(t: float, s: float) -> float:
    """Density at atmospheric pressure, kg/m3 (UNESCO 1981, report 38)."""
    fresh = [999.842594, 6.793952e-2, -9.09529e-3, 1.001685e-4, -1.120083e-6, 6.536332e-9]
    linear = polyval(t, [8.24493e-1, -4.0899e-3, 7.6438e-5, -8.2467e-7, 5.3875e-9])
    root = polyval(t, [-5.72466e-3, 1.0227e-4, -1.6546e-6])
    return polyval(t, fresh) + linear * s + root * s**1.5 + 4.8314e-4 * s**2


def _activity_slope(t: float, s: float) -> float:
    """Slope of the logarithm of the water activity with salinity (Millero & Leung 1976)."""
    constant = polyval(t, [-5.58651e-4, 2.40452e-7, -3.12165e-9, 2.40808e-11])
    root = polyval(t, [1.79613e-5, -9.9422e-8, 2.08919e-9, -1.39872e-11])
    linear = polyval(t, [-2.31065e-6, -1.37674e-9, -1.93316e-11])
    return constant + 1.5 * root * s**0.5 + 2 * linear * s
