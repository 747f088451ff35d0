"""A ferry that avoids collisions: `jast.simulators.colav`."""
