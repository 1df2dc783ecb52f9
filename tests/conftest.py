"""Every test runs in float64, under strict dtype promotion, without silent rank promotion,
with run-time shape checks of all annotated functions."""

import os

import jaxlib

if jaxlib.__version__.startswith("0.10."):
    # As the command line does: most of a test is compiling, and this halves it.  Not imported
    # from there, for the package must not load before its annotations are hooked.
    quick = " --xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0"
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + quick

# Programs that earlier runs stored would not be traced, and so not be checked.
os.environ["JAX_ENABLE_COMPILATION_CACHE"] = "false"

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

install_import_hook(["oceaninv", "fitting"], "beartype.beartype")


@pytest.fixture(autouse=True)
def _fixed_configuration():
    """The library never touches jax.config: a test that changes it must put it back."""
    before = jax.config.values.copy()
    yield
    assert jax.config.values == before
