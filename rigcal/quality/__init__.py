"""Metrics, and the gates that turn them into a verdict."""
