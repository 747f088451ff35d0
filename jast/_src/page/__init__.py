"""Pages to hand on: one HTML file each, which needs no network and no Python.

A page is a skeleton of escaped words, its data as JSON, and a little JavaScript of our own that
draws what is in the data (`page.js`, then one script for each kind of page). No library.
"""
