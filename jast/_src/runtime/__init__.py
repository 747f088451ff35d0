"""How long work runs: threads, devices, executors, bars, checkpoints, compilation."""
