"""Estimation of failure probabilities."""

__all__ = []
