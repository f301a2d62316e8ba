"""Measuring a reconstruction: protocols, trivial rows, tables and the report page."""

from evsplat.evaluation.evaluator import evaluate

__all__ = ["evaluate"]
