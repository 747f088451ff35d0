"""The search for a proposal: explore, adapt, audit, draw."""
