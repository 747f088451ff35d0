"""Populations of points on the device, moved down the levels of the miss distance."""
