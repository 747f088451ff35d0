"""Failure probabilities: populations, importance sampling, subset simulation, counts."""
