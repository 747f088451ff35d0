"""`jast.stress`: one call that looks for the likeliest failures with all that jast has."""
