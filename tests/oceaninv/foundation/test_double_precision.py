"""Functions in float64 whatever JAX is set to, and the promotion of their arguments."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.foundation.double_precision import in_double_precision, promoted


def test_the_setting_of_the_caller_stays_as_it_was():
    with jax.enable_x64(False):
        _setting()


def _setting():
    seen = in_double_precision(lambda x: (jnp.asarray(x).dtype, jax.config.jax_enable_x64))
    assert seen(np.ones(2)) == (jnp.float64, True)
    assert not jax.config.jax_enable_x64

    @in_double_precision
    def fails():
        raise ValueError("no such water")

    with pytest.raises(ValueError, match="no such water"):
        fails()
    assert jnp.ones(1).dtype == jnp.float32


@dataclasses.dataclass(frozen=True)
class _Held:
    name: str
    number: object


def test_numbers_in_float32_become_the_decimals_that_were_written():
    table = np.loadtxt(["0.1 1.33 4.7e-5 1e-45 3.4e38 0.123456"])
    with jax.enable_x64(False):
        kept = jnp.asarray(table)
        index = jnp.asarray(1.33 + 0.01j)
    given = {"z": _Held("a", kept), "a": (index, kept), "n": np.float32(0.7), "none": None}
    new = promoted(given)
    assert list(new) == list(given)
    np.testing.assert_array_equal(new["z"].number, table)
    np.testing.assert_array_equal(new["a"][1], table)
    assert new["a"][0] == 1.33 + 0.01j
    assert new["a"][0].dtype == np.complex128
    assert new["n"] == 0.7
    assert given["z"].number is kept


def test_every_number_of_float32_rounds_to_itself():
    bits = np.random.default_rng(0).integers(0, 2**32, 20000, dtype=np.uint32)
    numbers = bits.view(np.float32)
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan], np.float32)
    numbers = np.concatenate([numbers[~np.isnan(numbers)], special])
    assert promoted(numbers).dtype == np.float64
    assert promoted(numbers).astype(np.float32).tobytes() == numbers.tobytes()


def test_what_holds_no_float32_is_handed_on_itself():
    given = {"b": np.ones(2), "a": [jnp.arange(3), object(), "text", None, jax.random.key(0)]}
    assert promoted(given) is given
