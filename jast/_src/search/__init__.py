"""Searches for failures."""
