"""The models and requirements of ARCH-COMP."""
