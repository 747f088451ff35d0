"""Strict JAX for every test: no silent promotion, two CPU devices, warnings are errors; one cache
of compiled programs for workers, kernels of notebooks and other processes. ``JAST_X64=1`` runs
the whole suite in float64.
"""

import gc
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy and SciPy are imported
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR",
    str(Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "jast-tests"),
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

# tracing makes many objects that live long: collecting them less often saves a twentieth
gc.set_threshold(200_000, 50, 100)
jax.config.update("jax_traceback_in_locations_limit", 0)
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_enable_x64", os.environ.get("JAST_X64", "0") == "1")

OPTIMISED = "--xla_cpu_parallel_codegen_split_count=1"
"""Optimises in three fifths of the CPU time (28 s for 47 of one call of `stress`, which is mostly
compilation); long loops run a fifth slower than a user's.
"""
if jax.version.__version_info__ < (0, 11):  # later ones have none to turn off
    OPTIMISED += " --xla_cpu_use_fusion_emitters=false"
QUICK = OPTIMISED + " --xla_backend_optimization_level=0"
"""Compiles small programs in a seventh of the time; they run slower and round otherwise. A test
that needs the optimised compiler is marked long (soft actor-critic learns NaN without it).
"""


def pytest_configure(config):
    """Short and slow tests are compiled quickly, the long ones are optimised."""
    quick = "not long", "not long and not slow", "slow and not long"
    os.environ.setdefault("XLA_FLAGS", QUICK if config.option.markexpr in quick else OPTIMISED)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """What depends on the compiler is long: it runs as users have it, optimised."""
    for item in items:
        if "equal" in item.fixturenames:
            item.add_marker("compiled")
        if item.get_closest_marker("compiled"):
            item.add_marker("long")


@pytest.fixture
def key(request):
    """A key of the test's own, the same in every run."""
    return jax.random.key(sum(map(ord, request.node.nodeid)))


@pytest.fixture
def x64():
    """float64 for one test, whatever the suite runs in."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """float32, and float64 inside its context, whatever the suite runs in."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param


@pytest.fixture(autouse=True)
def close_figures():
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


@pytest.fixture
def traced():
    """The names of the functions that JAX traces from here on: a list that grows. A function that
    is called inside of another is not heard.
    """
    names = []

    def heard(event, _, fun_name="", **about):
        if event == "/jax/core/compile/jaxpr_trace_duration":
            names.append(fun_name)

    def new(x):
        return x + 1

    jax.monitoring.register_event_duration_secs_listener(heard)
    jax.jit(new)(1.0)
    assert names == ["new"]
    yield names
    jax.monitoring.unregister_event_duration_listener(heard)


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


MAPS = Path("/proc/self/maps")


@pytest.fixture(autouse=True, scope="module")
def let_programs_go():
    """Compiled programs take memory, and maps of it, of which a process may have 65,530: they are
    forgotten at the end of a file where there are many (4000 maps are some 2.5 GB).
    """
    yield
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > 4000:
        jax.clear_caches()
