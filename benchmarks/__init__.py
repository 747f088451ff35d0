"""Benchmarks: what jast is compared with, and how fast it is."""
