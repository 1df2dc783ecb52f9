"""Constituents of each of several layers of water: unknowns, the water, and its quantities.

The layers share the shapes of their optical properties (slopes, specific values); chlorophyll, CDOM
and detritus differ, and so does every layer's thickness, which the light itself fixes better than
the layers of Kd that the search starts from.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.core.parameters import Parameter, Parameters
from fitting.core.result import Description
from fitting.water_model.quantities import MARKS
from fitting.water_model.unknowns import constituents, water_iops, water_unknowns
from oceaninv import FlatSurface, IOPs, Layers, Light, Scene
from oceaninv.transport.base import AbstractTransport
from oceaninv.transport.plane_parallel.plane_parallel import PlaneParallel

Values = Mapping[str, Float[Array, ""]]
_NAMES = tuple(p.name for p in constituents())


def layer_unknowns(interfaces: Sequence[float], solar_zenith: float | None) -> list[Parameter]:
    """Constituents `<name>_<layer>` from the top down, the thickness of every layer but the last,
    and the nuisances that all layers share."""
    amounts, rest = [], []
    for p in water_unknowns(solar_zenith):
        (amounts if p.name in _NAMES else rest).append(p)
    count = len(interfaces) + 1
    made = [
        dataclasses.replace(p, name=f"{p.name}_{layer}", layer=layer)
        for layer in range(1, count + 1)
        for p in amounts
    ]
    thickness = np.diff(interfaces, prepend=0.0)
    made += [
        Parameter(_thickness(layer), float(metres), None, unit="m", kind="thickness", layer=layer)
        for layer, metres in enumerate(thickness, start=1)
    ]
    return [*made, *rest]


def interfaces_of(parameters: Parameters, x: np.ndarray) -> list[float]:
    """Depths of the interfaces at coordinates x, m."""
    return np.asarray(interfaces(parameters.values(jnp.asarray(x)))).tolist()


def roundings(edges: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Half of the widest step between samples about each interface, m: the depth resolution."""
    places = np.unique(depth)  # a sensor may dwell
    steps = np.diff(places)
    at = np.searchsorted(places, edges)
    return np.array([0.5 * steps[max(i - 2, 0) : i + 1].max() for i in at])


def check_layers(transport: AbstractTransport) -> None:
    """ValueError unless the transport models layers of water."""
    if not isinstance(transport, PlaneParallel):
        raise ValueError(
            f"{type(transport).__name__} models one homogeneous water: for constituents in layers "
            "take PlaneParallel, or fit one layer."
        )


def water_of(values: Values, wavelength: np.ndarray) -> IOPs | Layers:
    """The water with `values`: one, or layers where they name thicknesses."""
    if _thickness(1) in values:
        return layers_of(values, wavelength)
    return water_iops(values, wavelength)


def interfaces(values: Values) -> Float[Array, " interface"]:
    """Depths of the interfaces, m, as the depth sensor measures them."""
    names = itertools.takewhile(values.__contains__, map(_thickness, itertools.count(1)))
    return jnp.cumsum(jnp.stack([values[name] for name in names]))


def _thickness(layer: int) -> str:
    """Name of the thickness of a layer."""
    return f"thickness_{layer}"


def layers_of(values: Values, wavelength: np.ndarray) -> Layers:
    """The layers with `values`."""
    edges = interfaces(values)
    waters = [_layer(values, i, wavelength) for i in range(1, len(edges) + 2)]
    # `kd_model_error` stretches depths, and the layers with them.
    return Layers(edges * (1.0 + values["kd_model_error"]), waters)


def _layer(values: Values, layer: int, wavelength: np.ndarray) -> IOPs:
    return water_iops({**values, **{n: values[f"{n}_{layer}"] for n in _NAMES}}, wavelength)


def layer_units(count: int) -> dict[str, Description]:
    """What `layer_quantities` of so many layers are."""
    text = "diffuse attenuation coefficient, mean over the depths that were used"
    units = {"Kd": Description("m-1", text, "Kd")}
    for i in range(1, count + 1):
        of_layer = {
            "Kd_490": Description("m-1", f"Kd at 490 nm, mean over layer {i}", "Kd"),
            "c_550": Description(
                "m-1", f"beam attenuation coefficient at 550 nm of layer {i}", "c"
            ),
            "bb_550": Description(
                "m-1", f"backscattering coefficient at 550 nm of layer {i}", "bb"
            ),
            "a_cdm_440": Description(
                "m-1", f"absorption by CDOM and detritus at 440 nm of layer {i}", "a_cdm"
            ),
        }
        units |= {f"{name}_{i}": description for name, description in of_layer.items()}
    return units


def layer_quantities(
    values: Values, wavelength: np.ndarray, transport: AbstractTransport, deepest_sample
) -> dict[str, Float[Array, "..."]]:
    """The quantities named by `layer_units`.

    `deepest_sample`: (wl,) depth of the deepest sample of each band, m.

    The last layer's Kd is the mean down to the deepest sample of all.
    """
    grid = np.union1d(wavelength, MARKS)
    at_440, at_490, at_550 = np.searchsorted(grid, MARKS)
    asked = np.searchsorted(grid, wavelength)
    water = layers_of(values, grid)
    error = 1.0 + values["kd_model_error"]
    last = water.interfaces[-1:]
    deepest = jnp.maximum(jnp.max(deepest_sample) * error, last + 1e-3)
    edges = jnp.concatenate([jnp.zeros_like(last), water.interfaces, deepest])
    light = Light(values["solar_zenith"], jnp.ones(len(grid), deepest.dtype))
    depths = jnp.concatenate([edges, deepest_sample * error])
    down = jnp.log(transport.irradiance(Scene(water, light, FlatSurface()), depths, None).Ed.value)
    at_edges, at_deepest = down[: len(edges)], down[len(edges) :, asked]
    found = {"Kd": (down[0, asked] - jnp.diagonal(at_deepest)) / deepest_sample}
    for i, own in enumerate(water.iops, start=1):
        row = dict(zip(own.absorbers, own.a_components, strict=True))
        fall = at_edges[i - 1, at_490] - at_edges[i, at_490]
        found |= {
            f"Kd_490_{i}": fall / (edges[i] - edges[i - 1]) * error,
            f"c_550_{i}": own.c[at_550],
            f"bb_550_{i}": own.bb[at_550],
            f"a_cdm_440_{i}": (row["cdom"] + row["detritus"])[at_440],
        }
    return found
