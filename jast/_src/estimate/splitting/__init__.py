"""Adaptive multilevel splitting over episodes."""
