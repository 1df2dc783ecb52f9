"""Traced programs that outlive the process."""

import os
import pickle
from types import SimpleNamespace

import equinox as eqx
import jax
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
    assert len(list(folder.glob("*.program"))) == 1
    np.testing.assert_array_equal(first["value"], [0.0, 2.0, 8.0])
    np.testing.assert_array_equal(second["value"], first["value"])
    np.testing.assert_array_equal(second["slope"], 2.0)


def test_other_statics_or_shapes_are_other_programs(folder):
    call()
    np.testing.assert_array_equal(call(power=1)["value"], [0.0, 2.0, 4.0])
    assert call(size=4)["value"].shape == (4,)
    assert TRACES == [2, 1, 2]
    assert len(list(folder.glob("*.program"))) == 3


def test_a_broken_file_is_made_anew(folder):
    call()
    (path,) = folder.glob("*.program")
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


def test_python_shares_the_programs_of_the_commands(tmp_path, monkeypatch):
    values = {"jax_compilation_cache_dir": None, "jax_enable_compilation_cache": True}
    monkeypatch.setattr(program_cache.jax, "config", SimpleNamespace(values=values))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert program_cache._folder() == str(tmp_path / "oceaninv" / "programs")
    values["jax_enable_compilation_cache"] = False
    assert program_cache._folder() is None


class _Planted:
    """What runs a command when it is unpickled."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.mkdir, (self.target,)


def test_a_planted_file_does_not_run(folder, tmp_path_factory):
    call()
    (path,) = folder.glob("*.program")
    traces = tmp_path_factory.mktemp("planted")
    signature = path.read_bytes()[:32]
    for i, start in enumerate((b"", b"\0" * 32, signature)):
        path.write_bytes(start + pickle.dumps(_Planted(str(traces / str(i)))))
        np.testing.assert_array_equal(call()["value"], [0.0, 2.0, 8.0])
    assert list(traces.iterdir()) == []


def test_no_damaged_file_is_used(folder):
    """Cut, changed in one byte, or another program's: the right result every time."""
    call(power=1)
    (other,) = folder.glob("*.program")
    call()
    (path,) = set(folder.glob("*.program")) - {other}
    good, rng = path.read_bytes(), np.random.default_rng(0)
    damaged = [other.read_bytes(), b"", good + b"x"]
    damaged += [good[:n] for n in rng.integers(1, len(good), 20)]
    for at in rng.integers(0, len(good), 40):
        damaged.append(good[:at] + bytes([good[at] ^ 1]) + good[at + 1 :])
    for content in damaged:
        path.write_bytes(content)
        assert program_cache._load(path) is None
    np.testing.assert_array_equal(call()["value"], [0.0, 2.0, 8.0])


@pytest.mark.parametrize("name", ["", "key"])
def test_a_folder_or_key_that_others_may_change_is_not_trusted(name, folder):
    call()
    (folder / name).chmod(0o777)
    np.testing.assert_array_equal(call()["value"], [0.0, 2.0, 8.0])
    assert TRACES == [2, 2]
    (folder / name).chmod(0o700 if name == "" else 0o600)
    call()
    assert TRACES == [2, 2]


def test_a_new_folder_belongs_to_its_user_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(program_cache, "_folder", lambda: str(tmp_path / "a" / "programs"))
    call()
    assert (tmp_path / "a" / "programs").stat().st_mode & 0o777 == 0o700
    assert (tmp_path / "a" / "programs" / "key").stat().st_mode & 0o777 == 0o600


def test_a_program_is_of_the_precision_of_its_caller(folder):
    """Also where another thread compiles it, whose setting is the process's own."""

    def told(x):
        return jnp.sum(x), jnp.zeros(())

    with jax.enable_x64(False):
        program, x = cached_jit(told), jnp.ones(2, jnp.float32)
        program.prepare(x)
        assert program(x)[1].dtype == jnp.float32
    with jax.enable_x64(True):
        program.prepare(x)
        assert program(x)[1].dtype == jnp.float64
    assert len(list(folder.glob("*.program"))) == 2


class _Own(eqx.Module):
    """A model of the user's own, which may be another one in the next process."""

    slope: float = eqx.field(static=True)

    def __call__(self, x):
        TRACES.append("own")
        return self.slope * x


def test_code_that_the_key_does_not_cover_is_not_stored(folder):
    program = cached_jit(lambda model, x: model(x))
    program.prepare(_Own(2.0), jnp.ones(2))
    np.testing.assert_array_equal(program(_Own(2.0), jnp.ones(2)), 2.0)
    assert TRACES == ["own"]
    assert list(folder.glob("*.program")) == []
