"""Suites of captures x methods x seeds, run on one machine or a Ray cluster, in one table."""
