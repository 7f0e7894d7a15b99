"""QUAD from Python."""

from quad_rl._evaluate import Evaluators, evaluate

__all__ = ["Evaluators", "evaluate"]
