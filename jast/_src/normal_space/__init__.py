"""Episodes as points of independent standard normal numbers, and moves among them."""
