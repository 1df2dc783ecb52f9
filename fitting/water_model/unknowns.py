"""The bio-optical model of a fit: unknowns, their priors, and the optical properties."""

import math
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.core.parameters import Identity, Log, Logit, Parameter
from fitting.water_model.alternatives import assumed, ratios
from oceaninv import CDOM, BioOpticalModel, Constituents, Detritus, IOPs, Minerals, Phytoplankton
from oceaninv.foundation.tables import load
from oceaninv.water.bio_optics import particle_phase


def constituents() -> tuple[Parameter, ...]:
    """Chlorophyll, CDOM and detritus, each with a prior decades wide."""
    return (
        Parameter("chlorophyll", 0.5, 2.3, unit="mg m-3"),
        Parameter("cdom", 0.05, 2.3, unit="m-1"),
        Parameter("detritus", 0.03, 2.3, unit="m-1"),
    )


def shape_nuisances() -> tuple[Parameter, ...]:
    """What the default bio-optical model fixes but nature varies, with its natural variability.

    - `detritus_scattering_ratio`: scattering over absorption of detritus at 400 nm, b_d/a_d(400):
      5 within a factor of 2.
    - `cdom_slope`, `detritus_slope`: /nm; centred as in Babin et al. 2003, spread so as to hold
      other seas and spectral ranges: 0.010-0.025 for CDOM (Bricaud et al. 1981; Roesler et al.
      1989; Twardowski et al. 2004), 0.009-0.016 for detritus.
    - `detritus_exponent`: spectral slope of non-algal scattering, between that of minerals (0.3,
      Babin et al. 2003) and of organic detritus (0.9, Stramski et al. 2001).
    - `phytoplankton_exponent`: spectral slope of algal scattering, between 1 (Gordon & Morel 1983)
      and 0 (Morel & Maritorena 2001, above 2 mg/m3).
    - `phytoplankton_absorption`, `phytoplankton_scattering`: factors on the specific values.
    - `backscatter`: factor on the backscatter ratio of all particles.
    """
    return (
        Parameter("detritus_scattering_ratio", 5.0, math.log(2.0), nuisance=True),
        Parameter("cdom_slope", 0.0176, 0.25, unit="nm-1", nuisance=True),
        Parameter("detritus_slope", 0.0123, 0.15, unit="nm-1", nuisance=True),
        Parameter("detritus_exponent", 0.6, 0.5, Identity(), nuisance=True),
        Parameter("phytoplankton_exponent", 0.5, 0.5, Identity(), nuisance=True),
        Parameter("phytoplankton_absorption", 1.0, 0.4, nuisance=True),
        Parameter("phytoplankton_scattering", 1.0, 0.5, nuisance=True),
        # Within the phase functions at hand; 1.1 of the log-odds is a factor of 1.6.
        Parameter("backscatter", 1.0, 1.1, Logit(0.4, 2.75), nuisance=True),
    )


_SHAPE_KNOTS = (412, 443, 490, 555, 620, 670)


def absorption_shapes() -> tuple[Parameter, ...]:
    """Deviation of the absorption spectrum of everything but water from the model's sum.

    Factors at six wavelengths, linear between them.  Algae differ in the shape of their
    absorption by a third at equal chlorophyll (Bricaud et al. 1995, fig. 3), CDOM and detritus from
    exponentials by less; 0.3 holds either.
    """
    return tuple(
        Parameter(f"shape_{nm}", 1.0, 0.3, nuisance=True, kind="shape", wavelength=float(nm))
        for nm in _SHAPE_KNOTS
    )


def pigment_packaging() -> Parameter:
    """How packaged the algae's pigments are, as a factor on the chlorophyll that sets the *shape*
    of their absorption.

    Bricaud et al. 1998 give a mean shape for every chlorophyll, flatter the more there is; at equal
    chlorophyll, cells of other sizes have other shapes.  Without this unknown, the mean shape alone
    would determine chlorophyll to a tenth.  A factor of 3.3 moves the ratio of red to blue
    absorption by a third, the scatter of Bricaud et al. 1995 (fig. 3).
    """
    return Parameter("phytoplankton_package", 1.0, 1.2, nuisance=True)


def _packaged(water: IOPs, values: Mapping[str, Float[Array, ""]]) -> IOPs:
    if "phytoplankton_package" not in values:
        return water
    table = load("Bricaud1998")
    beyond = table.at(water.wavelength, "E_phi") - table.at(np.array([440.0]), "E_phi")
    # a ~ A C^E: the shape of another chlorophyll, the absorption at 440 nm of this one.
    change = values["phytoplankton_package"]
    factor = change ** jnp.asarray(np.asarray(beyond), change.dtype)
    rows = [
        row * factor if name == "chlorophyll" else row
        for name, row in zip(water.absorbers, water.a_components, strict=True)
    ]
    return eqx.tree_at(lambda water: water.a_components, water, jnp.stack(rows))


def _shaped(water: IOPs, values: Mapping[str, Float[Array, ""]]) -> IOPs:
    if f"shape_{_SHAPE_KNOTS[0]}" not in values:
        return water
    knots = np.eye(len(_SHAPE_KNOTS))
    hats = np.stack([np.interp(water.wavelength, _SHAPE_KNOTS, row) for row in knots])
    factor = jnp.stack([values[f"shape_{nm}"] for nm in _SHAPE_KNOTS]) @ hats
    rows = [
        row if name == "water" else row * factor
        for name, row in zip(water.absorbers, water.a_components, strict=True)
    ]
    return eqx.tree_at(lambda water: water.a_components, water, jnp.stack(rows))


def water_unknowns(solar_zenith: float | None) -> tuple[Parameter, ...]:
    """Constituents, the nuisances of their shapes, and those of the light's way down."""
    return (
        *constituents(),
        *shape_nuisances(),
        # Refraction keeps the sun within 48 degrees under water, so that an unknown zenith angle
        # matters little; the spread also covers an unknown share of sky light.
        Parameter(
            "solar_zenith",
            40.0 if solar_zenith is None else max(solar_zenith, 1.0),
            0.4 if solar_zenith is None else 0.05,
            Log(),
            "degree",
            True,
        ),
        # Relative error of the closed form in Kd.
        Parameter("kd_model_error", 0.0, 0.02, Identity(), "1", True),
    )


def modelled_bands(wavelength: np.ndarray) -> np.ndarray:
    """(wl,) whether the tables of `water_iops` cover a wavelength (nm), named extension included.

    Phytoplankton absorption has the narrowest table: 380-780 nm (Sathyendranath, Lazzara & Prieur
    1987), within that of pure water (IOCCG 2018, 300-800 nm).
    """
    low, high = phytoplankton_range()
    return (wavelength >= low) & (wavelength <= high)


def phytoplankton_range() -> tuple[float, float]:
    """Shortest and longest wavelength (nm) at which absorption by phytoplankton is tabulated."""
    table = load("Gutierrez2008").wavelength
    return float(table[0]), float(table[-1])


def water_iops(values: Mapping[str, Float[Array, ""]], wavelength: np.ndarray):
    """IOPs of the default model with whichever nuisances `values` names.

    Wavelengths beyond 400-700 nm use the named extension of phytoplankton absorption.
    """

    def get(name, default):
        return values.get(name, default)

    outside = wavelength[0] < 400.0 or wavelength[-1] > 700.0
    factor = get("backscatter", 1.0)
    of_algae, of_others = ratios(values)
    model = BioOpticalModel(
        (
            Phytoplankton(
                absorption_scale=get("phytoplankton_absorption", 1.0),
                scattering_at_550=0.30 * get("phytoplankton_scattering", 1.0),
                exponent=get("phytoplankton_exponent", 1.0),
                phase=particle_phase(of_algae * factor),
                extension="Sathyendranath1987" if outside else None,
            ),
            CDOM(slope=get("cdom_slope", 0.0176)),
            Detritus(
                slope=get("detritus_slope", 0.0123),
                scattering_ratio=get("detritus_scattering_ratio", 5.0),
                exponent=get("detritus_exponent", 0.9),
                phase=particle_phase(of_others * factor),
            ),
            Minerals(),
        )
    )
    names = ("chlorophyll", "cdom", "detritus", "minerals")
    present = Constituents(**{n: values[n] for n in names if n in values})
    return assumed(_shaped(_packaged(model.iops(present, wavelength), values), values), values)
