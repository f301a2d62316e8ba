"""Measuring a reconstruction: protocols, trivial rows, tables and the report page."""

from evsplat.evaluation.evaluator import evaluate
from evsplat.evaluation.protocols import AVATAR_COMPAT, HUGS_COMPAT, PROTOCOLS, STANDARD, Protocol

__all__ = ["AVATAR_COMPAT", "HUGS_COMPAT", "PROTOCOLS", "STANDARD", "Protocol", "evaluate"]
