"""Estimates from few runs, by a surrogate that learns where it is unsure."""
