"""Networks that guide trees, and their training."""
