"""Exponential tilts of each step as proposals."""
