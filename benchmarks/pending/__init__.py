"""Suites that are written and have no committed figures yet: moved to suite with their first baseline."""
