"""Search from kept states."""
