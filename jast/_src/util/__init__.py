"""Checks of arguments, public doors, pytrees, how results print, intervals."""
