"""Requirements in signal temporal logic."""
