"""The water of a scene file: constituents, Jerlov types, Mie media, tables of a and b or of Kd."""

import itertools

import jax.numpy as jnp
import numpy as np

from oceaninv.foundation import tables
from oceaninv.mie import media
from oceaninv.scene._toml_section import Section, spectra
from oceaninv.water import phase, pure_water
from oceaninv.water.attenuation import kd_lee2005
from oceaninv.water.bio_optics import (
    JERLOV_SOURCES,
    BioOpticalModel,
    Constituents,
    gutierrez2008,
    jerlov,
    jerlov_types,
    measured_iops,
)
from oceaninv.water.iops import IOPs, Layers

_AMOUNTS = {
    "chlorophyll_mg_m3": "chlorophyll",
    "cdom_440_per_m": "cdom",
    "detritus_400_per_m": "detritus",
    "minerals_g_m3": "minerals",
}
_KINDS = ("jerlov_type", "medium", "table", "kd_table", "layers")
_NO_LIMIT = 1e30


def read_water(table: Section, wavelength: np.ndarray) -> tuple[IOPs | Layers, np.ndarray | None]:
    """The water of a section, and the measured Kd if the section gives one."""
    if not table.has("layers"):
        return _homogeneous(table, wavelength)
    layers = table.sections("layers")
    if len(layers) < 2:
        raise table.error("layers", f"{len(layers)} table", "at least two tables [[water.layers]]")
    bottoms = [layer.number("bottom_m", 1e-3, 1e5) for layer in layers[:-1]]
    if any(below <= above for above, below in itertools.pairwise(bottoms)):
        raise table.error("layers", bottoms, "layers whose bottom_m increases downwards")
    waters = [_homogeneous(layer, wavelength)[0] for layer in layers]
    table.finish()
    return Layers(jnp.asarray(bottoms), waters), None


def _homogeneous(table: Section, wavelength: np.ndarray) -> tuple[IOPs, np.ndarray | None]:
    kinds = [kind for kind in _KINDS if table.has(kind)]
    amounts = [key for key in _AMOUNTS if table.has(key)]
    if len(kinds) + bool(amounts) != 1:
        raise ValueError(
            f"{table.path}: {table.name} must describe its water in one way, by constituents "
            f"({', '.join(_AMOUNTS)}) or by one of {', '.join(_KINDS)}; it has "
            f"{', '.join(kinds + amounts) or 'none'}."
        )
    kd = None
    if amounts:
        result = _constituents(table, wavelength)
    elif kinds == ["jerlov_type"]:
        source = table.text("source", JERLOV_SOURCES, JERLOV_SOURCES[0])
        kind = table.text("jerlov_type", jerlov_types(source))
        result = jerlov(kind, wavelength, source, _phase(table))
    elif kinds == ["medium"]:
        result = _medium(table).iops(wavelength, shapes=min(3, wavelength.size))
    elif kinds == ["table"]:
        a, b = spectra(table.file("table"), wavelength, "a_per_m", "b_per_m")
        result = measured_iops(wavelength, a, b, _phase(table))
    else:
        result, kd = _from_kd(table, wavelength)
    table.finish()
    return result, kd


def _constituents(table: Section, wavelength: np.ndarray) -> IOPs:
    values = {name: table.number(key, 0.0, _NO_LIMIT, None) for key, name in _AMOUNTS.items()}
    if table.text("model", ("default", "gutierrez2008"), "default") == "gutierrez2008":
        model = gutierrez2008()
    else:
        model = BioOpticalModel(
            water_absorption=table.text("water_absorption", default="IOCCG2018"),
            temperature=table.number("temperature_deg_c", 0.0, 30.0, None),
            salinity=table.number("salinity", 0.0, 40.0, None),
        )
    # A fixed dtype, whatever the numbers in the file look like.
    amounts = {k: None if v is None else jnp.asarray(v, dtype=float) for k, v in values.items()}
    return model.iops(Constituents(**amounts), wavelength)


def _phase(table: Section) -> phase.AbstractPhase | None:
    names = ("Petzold1972", "HenyeyGreenstein", "FournierForand", "isotropic")
    name = table.text("phase", names, None)
    if name is None:
        return None
    if name == "HenyeyGreenstein":
        return phase.HenyeyGreenstein(table.number("asymmetry", -0.99, 0.99))
    if name == "FournierForand":
        return phase.FournierForand(table.number("backscatter_ratio", 1e-3, 0.3))
    return phase.Isotropic() if name == "isotropic" else phase.petzold()


def _medium(table: Section) -> media.Medium:
    kind = table.text("medium", ("milk", "natural water", "ice"))
    radii = table.integer("radii", 10, 5000, 100)
    if kind == "milk":
        return media.milk(
            table.number("fat_percent", 0.0, 10.0),
            table.number("protein_percent", 0.0, 10.0),
            radii=radii,
        )
    if kind == "natural water":
        return media.natural_water(
            table.text("sea", media.SEAS, None),
            algae=table.number("algae_fraction", 0.0, 1.0, None),
            minerals=table.number("minerals_fraction", 0.0, 1.0, None),
            radii=radii,
        )
    names = ("air", "brine", "minerals", "algae")
    return media.ice(
        **{n: table.number(f"{n}_fraction", 0.0, 1.0, 0.0) for n in names}, radii=radii
    )


def _from_kd(table: Section, wavelength: np.ndarray) -> tuple[IOPs, np.ndarray]:
    """a and b of a water of which only Kd was measured.

    Kd alone cannot tell them apart.  Particles scatter as b_550 (550/wavelength); where b_550 is
    not stated, it is that of the algae whose chlorophyll Kd(490) shows (Morel & Maritorena 2001:
    Kd = Kw + chi C^e; Gordon & Morel 1983: b_550 = 0.30 C^0.62).  Then a is what Lee et al. 2005
    need to give the measured Kd under a sun at 30 degrees, with bb = bb/b times b.
    """
    path = table.file("kd_table")
    (kd,) = spectra(path, wavelength, "kd_per_m")
    if np.any(kd <= 0):
        raise ValueError(f"{path}: kd_per_m must be positive.")
    ratio = table.number("backscatter_ratio", 1e-3, 0.3)
    b550 = table.number("b_550_per_m", 0.0, _NO_LIMIT, None)
    if b550 is None:
        (kd490,) = spectra(path, np.array([490.0]), "kd_per_m")
        morel = tables.load("MorelMaritorena2001")
        kw, chi, exponent = (morel.at([490.0], column)[0] for column in ("Kw", "chi", "e"))
        excess = max(float(kd490[0]) - kw, 1e-4)
        b550 = 0.30 * (excess / chi) ** (0.62 / exponent)
    b = b550 * 550.0 / wavelength
    molecules = pure_water.scattering(wavelength)
    bb = ratio * b + 0.5 * molecules
    low, high = np.zeros_like(kd), kd.copy()
    if np.any(np.asarray(kd_lee2005(jnp.asarray(low), jnp.asarray(bb), 30.0)) > kd):
        raise table.error(
            "backscatter_ratio",
            ratio,
            f"smaller: with b(550) = {b550:.3g} /m the backscattering alone exceeds Kd",
        )
    for _ in range(60):
        middle = 0.5 * (low + high)
        over = np.asarray(kd_lee2005(jnp.asarray(middle), jnp.asarray(bb), 30.0)) > kd
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    shapes = (phase.Seawater(pure_water.phase_constant()), phase.FournierForand(ratio))
    rows = jnp.asarray(np.stack([molecules, b]))
    return IOPs(wavelength, jnp.asarray(low), rows, shapes), kd
