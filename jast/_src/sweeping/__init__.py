"""`jast.sweep`: one function on many systems that differ in a setting."""
