"""Figures that the project claims, measured, with a committed baseline."""
