"""From failures to the likeliest of each mode."""
