"""What is loaded when: heavy packages where they are used, rooms when they are entered."""

import subprocess
import sys

import pytest

HEAVY = ["distrax", "tensorflow_probability", "flax", "optax", "chex", "matplotlib", "scipy"]
HEAVY += ["sklearn", "tqdm", "loky", "pandas", "xarray", "numpyro"]
LOADED = f"import sys; print([m for m in {HEAVY} if m in sys.modules])"


def printed(code):
    command = [sys.executable, "-c", code]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.mark.slow
def test_jast_and_its_rooms_load_nothing_heavy():
    assert printed(f"import jast; {LOADED}").strip() == "[]"
    rooms = "import jast; [getattr(jast, name) for name in jast.__all__]"
    assert printed(f"{rooms}; {LOADED}").strip() == "[]"


@pytest.mark.slow
def test_the_main_job_loads_neither_distrax_nor_what_is_below_it():
    """A search and an estimate on a simulator of the package; intervals need scipy."""
    job = (
        "import jax, jast; sim = jast.simulators.walk1d();"
        "jast.search.monte_carlo(jax.random.key(0), sim, episodes=100);"
        "jast.estimate.monte_carlo(jax.random.key(0), sim, 100);"
    )
    assert printed(f"{job}{LOADED}").splitlines()[-1] == "['scipy']"


@pytest.mark.slow
def test_the_command_line_loads_nothing_heavy():
    code = "import runpy, sys; sys.argv = ['jast', '--help']\n"
    code += "try: runpy.run_module('jast', run_name='__main__')\nexcept SystemExit: pass\n"
    assert printed(code + LOADED).splitlines()[-1] == "[]"


@pytest.mark.slow
def test_distrax_is_reached_by_its_names():
    code = "from jast import distributions as D; import sys; print('distrax' in sys.modules);"
    code += (
        "import jax; print(D.VonMises.__module__, D.VonMises is __import__('distrax').VonMises);"
    )
    assert printed(code).split() == ["False", "distrax._src.distributions.von_mises", "True"]


@pytest.mark.slow
def test_a_user_of_distrax_may_put_distributions_of_jast_into_its_containers():
    printed(
        "import jax, jax.numpy as jnp; from jast.distributions import Normal; import distrax;"
        "d = distrax.Independent(Normal(jnp.zeros(2), 1.0), 1);"
        "assert d.sample(seed=jax.random.key(0)).shape == (2,)"
    )


def test_importing_jast_alone_does_not_import_jax():
    assert printed("import jast, sys; print('jax' in sys.modules)").strip() == "False"


def test_a_simulator_and_its_distributions_load_no_pallas():
    """`jax.extend` loads it: a quarter of what the names of the first cell of a notebook take."""
    first = "import jast, sys; jast.Simulator, jast.distributions.Normal"
    assert printed(f"{first}; print('jax._src.pallas' in sys.modules)").strip() == "False"


@pytest.mark.slow
def test_no_room_starts_a_device():
    """Settings of JAX hold only from before: `jax.config.update` after the imports is usual."""
    rooms = "import jast; [getattr(jast, name) for name in jast.__all__]"
    started = "from jax._src import xla_bridge; print(bool(xla_bridge._backends))"
    assert printed(f"{rooms}; {started}").strip() == "False"
