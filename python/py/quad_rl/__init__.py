"""QUAD from Python: training, trained policies, evaluators for your own environments, data from arrays, results of runs."""

from quad_rl._dataset import Dataset
from quad_rl._evaluate import Evaluators, evaluate
from quad_rl._lerobot import export_lerobot
from quad_rl._quad_rl import Episodes, Policy, Simulation
from quad_rl._runs import metrics, runs
from quad_rl._train import Run, train
from quad_rl.onnx import export_onnx

__all__ = ["Dataset", "Episodes", "Evaluators", "Policy", "Run", "Simulation", "evaluate", "export_lerobot", "export_onnx", "metrics", "runs", "train"]
