"""The contract of a simulator, and what one episode of it means."""
