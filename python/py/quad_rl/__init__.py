"""QUAD from Python: trained policies, data from arrays, results of runs."""

from quad_rl._dataset import Dataset
from quad_rl._quad_rl import Episodes, Policy
from quad_rl._runs import runs

__all__ = ["Dataset", "Episodes", "Policy", "runs"]
