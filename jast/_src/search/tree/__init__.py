"""Trees of a search: their layout in arrays, what grows them, and what is read off them."""
