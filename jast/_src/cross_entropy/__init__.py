"""Cross-entropy methods for functions of a vector, with surrogates and mixtures."""
