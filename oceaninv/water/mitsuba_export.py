"""Export of waters as participating media of the renderer Mitsuba 3."""

import jax.core
import jax.numpy as jnp
import numpy as np

from oceaninv.foundation.tables import check_wavelength
from oceaninv.water.iops import IOPs
from oceaninv.water.phase import AbstractPhase, HenyeyGreenstein, Isotropic, moments_of


def mitsuba_medium(water: IOPs, tabulated: bool = False, angles: int = 4001) -> dict:
    """A water as the dictionary of a homogeneous medium, for `mitsuba.load_dict`.

    **Arguments:**

    - `tabulated`: whether phase functions are tables of `angles` equal steps in the cosine;
      otherwise each is the Henyey-Greenstein function of its mean cosine (isotropic ones stay so),
      which has the right asymmetry but not the right backscattering.  A table flattens what lies
      within a step of the forward direction (1.3 degrees at 4001).

    Extinction (1/m) and albedo keep their spectra, linear between the bands; the phase functions
    are mixed by their share of the scattering averaged over the bands, as the renderer has no
    phase function that varies with wavelength.  Use a spectral variant (`scalar_spectral`) and
    metres.  Concrete values only.

    **Raises:** `ValueError` for traced values and for a water that does not scatter.
    """
    if isinstance(water.a_components, jax.core.Tracer):
        raise ValueError("an export needs concrete numbers: call it outside jit and grad.")
    wavelength = check_wavelength(water.wavelength)
    b = np.asarray(water.b_components, dtype=float)
    total = b.sum()
    if total <= 0:
        raise ValueError("this water does not scatter: there is no medium to export.")
    shares = b.sum(axis=1) / total
    shapes = [_shape(phase, tabulated, angles) for phase in water.phases]
    present = [i for i in range(len(shapes)) if shares[i] > 0]
    phase = shapes[present[0]]
    weight = shares[present[0]]
    # Mixtures of two, nested: `weight` is the share of the second.
    for i in present[1:]:
        weight = weight + shares[i]
        phase = {
            "type": "blendphase",
            "weight": float(shares[i] / weight),
            "phase_0": phase,
            "phase_1": shapes[i],
        }
    return {
        "type": "homogeneous",
        "sigma_t": _spectrum(wavelength, np.asarray(water.c)),
        "albedo": _spectrum(wavelength, np.asarray(water.albedo)),
        "phase": phase,
    }


def mitsuba_xml(water: IOPs, name: str = "water", tabulated: bool = False) -> str:
    """The same medium as text for a scene file, `<medium id="name">`."""
    medium = mitsuba_medium(water, tabulated)
    return "\n".join(_element("medium", medium, f' id="{name}"', 0)) + "\n"


def _shape(phase: AbstractPhase, tabulated: bool, angles: int) -> dict:
    if isinstance(phase, Isotropic):
        return {"type": "isotropic"}
    if tabulated:
        # Regular in the cosine from -1 (backward) to 1.
        values = np.asarray(phase(jnp.asarray(np.linspace(-1.0, 1.0, angles))), dtype=float)
        return {"type": "tabphase", "values": ", ".join(f"{v:.6g}" for v in values)}
    if isinstance(phase, HenyeyGreenstein):
        return {"type": "hg", "g": float(np.asarray(phase.g))}
    return {"type": "hg", "g": float(np.asarray(moments_of(phase, 1))[1])}


def _spectrum(wavelength: np.ndarray, values: np.ndarray) -> dict:
    return {
        "type": "irregular",
        "wavelengths": ", ".join(f"{w:g}" for w in wavelength),
        "values": ", ".join(f"{v:.6g}" for v in values),
    }


def _element(tag: str, node: dict, extra: str, depth: int) -> list[str]:
    """A plugin and its contents as lines of XML."""
    space = "  " * depth
    lines = [f'{space}<{tag} type="{node["type"]}"{extra}>']
    for key, value in node.items():
        if key == "type":
            continue
        if isinstance(value, dict):
            inner = "phase" if key.startswith("phase") else "spectrum"
            named = "" if inner == "phase" else f' name="{key}"'
            lines += _element(inner, value, named, depth + 1)
        else:
            kind = "float" if isinstance(value, float) else "string"
            lines.append(f'{space}  <{kind} name="{key}" value="{value}"/>')
    return [*lines, f"{space}</{tag}>"]
