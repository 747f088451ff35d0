"""Which inputs a classifier gets wrong."""
