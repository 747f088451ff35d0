"""Simulated systems with a source and a known truth."""
