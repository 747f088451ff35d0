"""Mixtures of Gaussians as proposals."""
