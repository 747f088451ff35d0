"""A flight management system with a defect: `jast.simulators.fms`."""
