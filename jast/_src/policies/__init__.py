"""Learned failure policies."""
