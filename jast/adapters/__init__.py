"""Environments of other libraries in JAX as a `jast.Simulator`: a policy is under test in them, and
the user names what is random. They are known by their methods; the libraries are not imported.

A Gymnasium environment: `jast.blackbox.gymnasium_system`.
"""

from jast.adapters.brax import brax
from jast.adapters.gymnax import gymnax
from jast.adapters.jumanji import jumanji
from jast.adapters.loop import Instant
from jast.adapters.mjx import mjx
from jast.adapters.pgx import pgx

__all__ = ["Instant", "brax", "gymnax", "jumanji", "mjx", "pgx"]
