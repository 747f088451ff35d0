"""Strict JAX for every test: no silent promotion, two CPU devices, warnings are errors.
``JAST_X64=1`` runs the whole suite in float64.
"""

import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy and SciPy are imported

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_enable_x64", os.environ.get("JAST_X64", "0") == "1")
jax.config.update(
    "jax_compilation_cache_dir",
    str(Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "jast-tests"),
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


@pytest.fixture
def key(request):
    """A key of the test's own, the same in every run."""
    return jax.random.key(sum(map(ord, request.node.nodeid)))


@pytest.fixture
def x64():
    """float64 for one test, whatever the suite runs in."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def equal():
    """Asserts that two pytrees are the same to the bit, NaN included."""

    def check(a, b):
        assert jax.tree.structure(a) == jax.tree.structure(b)
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            x, y = np.asarray(x), np.asarray(y)
            assert (x.dtype, x.shape) == (y.dtype, y.shape)
            np.testing.assert_array_equal(
                x.view(f"u{x.itemsize}") if x.dtype != bool else x,
                y.view(f"u{y.itemsize}") if y.dtype != bool else y,
            )

    return check


@pytest.fixture(autouse=True, scope="module")
def let_programs_go():
    """Compiled programs of one file are of no use to the next, and a process can hold only so many
    of them (each maps memory).
    """
    yield
    jax.clear_caches()
