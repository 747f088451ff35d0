"""jast.cache: compiled programs on disk."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import jast
from jast._src.runtime import compilation_cache

OPTIONS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.fixture(autouse=True)
def options_of_jax():
    """As they were before, after a test that changes them."""
    kept = {name: getattr(jax.config, name) for name in OPTIONS}
    yield
    for name, value in kept.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


PROGRAM = """
import sys, jax, jast
jax.jit(lambda x: x * 3)(1.0)  # the options count after a first program, too
seen = dict.fromkeys(("cache_hits", "cache_misses"), 0)
def heard(event, **about):
    name = event.rsplit("/", 1)[1]
    if name in seen:
        seen[name] += 1
jax.monitoring.register_event_listener(heard)
jast.cache(sys.argv[1])
key = jax.random.key(int(sys.argv[2]))
print(float(jast.estimate.monte_carlo(key, jast.simulators.walk1d(), 500).mean))
print(*seen.values())
"""


def told(folder, seed=0, flags=""):
    """(what a process computes, programs that it read, programs that it compiled)"""
    env = os.environ | {"XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, folder, str(seed)],
        env=env | {"PYTHONPATH": str(Path(jast.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    mean, counts = done.stdout.splitlines()
    return float(mean), *map(int, counts.split())


@pytest.mark.slow
def test_the_next_process_compiles_nothing(tmp_path):
    first, hits, compiled = told(tmp_path)
    assert hits == 0 and compiled > 0
    assert len(list(tmp_path.glob("*-cache"))) == compiled
    assert told(tmp_path) == (first, compiled, 0)
    assert told(tmp_path, seed=1)[2] == 0


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the flag is of x86")
def test_programs_for_other_cpu_features_are_not_read(tmp_path):
    _, _, compiled = told(tmp_path)
    assert told(tmp_path, flags="--xla_cpu_max_isa=SSE4_2")[1:] == (0, compiled)


def test_small_and_quick_programs_are_kept_where_it_says(tmp_path):
    assert jast.cache(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    jax.jit(lambda x: x * 1.25 + 17)(1.0)
    assert any((tmp_path / "a" / "b").glob("*-cache"))
    assert jast.cache() == tmp_path / "a" / "b"  # JAX's own, where there is one


@pytest.mark.parametrize(
    ("system", "variable", "folder"),
    [
        ("linux", "XDG_CACHE_HOME", "jast"),
        ("linux", None, ".cache/jast"),
        ("darwin", None, "Library/Caches/jast"),
        ("win32", "LOCALAPPDATA", "jast/cache"),
        ("win32", None, "AppData/Local/jast/cache"),
    ],
)
def test_the_folder_of_a_user(system, variable, folder, tmp_path, monkeypatch):
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, str(tmp_path))
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    monkeypatch.setattr(sys, "platform", system)
    jax.config.update("jax_compilation_cache_dir", None)
    assert jast.cache() == tmp_path / folder
    assert (tmp_path / folder).is_dir()


def test_the_oldest_go_where_there_are_too_many(tmp_path):
    for i, name in enumerate(("c", "a", "b", "d")):
        file = tmp_path / f"{name}-cache"
        file.write_bytes(bytes(100))
        os.utime(file, (i, i))
    (tmp_path / "other").write_bytes(bytes(1000))
    jast.cache(tmp_path, limit=250)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["b-cache", "d-cache", "other"]
    jast.cache(tmp_path, limit=0)
    assert [f.name for f in tmp_path.iterdir()] == ["other"]


def test_what_it_refuses(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="cache: folder must be one that can be made, received"):
        jast.cache(tmp_path / "file")
    with pytest.raises(ValueError, match="cache: folder must be one .* received 3"):
        jast.cache(3)
    with pytest.raises(ValueError, match="cache: limit must be a whole number of at least 0"):
        jast.cache(tmp_path, limit=-1)
