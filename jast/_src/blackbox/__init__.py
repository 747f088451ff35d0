"""Systems that are not written in JAX, behind the contract of a simulator."""
