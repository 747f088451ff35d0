"""Environments of other libraries in JAX as a `jast.Simulator`: a policy is under test in them, and
the user names what is random. They are known by their methods; the libraries are not imported.

A Gymnasium environment: `jast.blackbox.gymnasium_system`.
"""

from jast._src.adapters.brax import brax
from jast._src.adapters.closed_loop import Instant
from jast._src.adapters.gymnax import gymnax
from jast._src.adapters.jumanji import jumanji
from jast._src.adapters.mjx import mjx
from jast._src.adapters.pgx import pgx

__all__ = ["Instant", "brax", "gymnax", "jumanji", "mjx", "pgx"]
