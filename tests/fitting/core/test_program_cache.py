"""Traced programs that outlive the process."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from fitting.core import program_cache
from fitting.core.program_cache import cached_jit

TRACES = []


def _line(slope, x, power):
    TRACES.append(power)
    return {"value": slope * x**power, "slope": slope}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(program_cache, "_folder", lambda: str(tmp_path))
    TRACES.clear()
    return tmp_path


def call(power=2, size=3):
    """As a new process would: with nothing in memory."""
    return cached_jit(_line)(jnp.asarray(2.0), jnp.arange(float(size)), power)


def test_a_stored_program_is_not_traced_again(folder):
    first, second = call(), call()
    assert TRACES == [2]
    assert len(list(folder.iterdir())) == 1
    np.testing.assert_array_equal(first["value"], [0.0, 2.0, 8.0])
    np.testing.assert_array_equal(second["value"], first["value"])
    np.testing.assert_array_equal(second["slope"], 2.0)


def test_other_statics_or_shapes_are_other_programs(folder):
    call()
    np.testing.assert_array_equal(call(power=1)["value"], [0.0, 2.0, 4.0])
    assert call(size=4)["value"].shape == (4,)
    assert TRACES == [2, 1, 2]
    assert len(list(folder.iterdir())) == 3


def test_a_broken_file_is_made_anew(folder):
    call()
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:20])
    np.testing.assert_array_equal(call()["value"], [0.0, 2.0, 8.0])
    assert TRACES == [2, 2]
    call()
    assert TRACES == [2, 2]


def test_a_folder_that_cannot_be_written_costs_only_time(folder, monkeypatch):
    blocked = folder / "file"
    blocked.write_text("")
    monkeypatch.setattr(program_cache, "_folder", lambda: str(blocked / "programs"))
    np.testing.assert_array_equal(call()["value"], [0.0, 2.0, 8.0])


def test_without_a_folder_it_is_jit(monkeypatch):
    monkeypatch.setattr(program_cache, "_folder", lambda: None)
    np.testing.assert_array_equal(call()["value"], [0.0, 2.0, 8.0])


def test_a_program_prepared_beside_is_the_one_called(folder):
    program, x = cached_jit(_line), jnp.arange(3.0)
    for _ in range(2):
        program.prepare(jnp.asarray(2.0), x, 2)
    np.testing.assert_array_equal(program(jnp.asarray(2.0), x, 2)["value"], [0.0, 2.0, 8.0])
    assert TRACES == [2]


def test_an_error_while_preparing_is_the_call_s(folder):
    def fails(x):
        raise ValueError("no such water")

    program = cached_jit(fails)
    program.prepare(jnp.ones(2))
    with pytest.raises(ValueError, match="no such water"):
        program(jnp.ones(2))


def test_jax_s_own_cache_and_ours_keep_out_of_each_other_s_way(tmp_path, monkeypatch):
    values = {"jax_compilation_cache_dir": str(tmp_path), "jax_enable_compilation_cache": True}
    monkeypatch.setattr(program_cache.jax, "config", SimpleNamespace(values=values))
    assert program_cache._folder() is None
    values["jax_enable_compilation_cache"] = False
    assert program_cache._folder() == str(tmp_path)
